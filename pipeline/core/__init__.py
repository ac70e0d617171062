"""The runner: stages, manifests, strict configuration, locks, progress. Knows nothing of 3D."""
