"""Parts of published methods, which only the presets in data_tools/baselines use."""
