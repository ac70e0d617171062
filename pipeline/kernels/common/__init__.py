"""Code that several kernels share: dispatch, packing, threads, compile options."""
