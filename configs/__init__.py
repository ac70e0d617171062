"""Presets: `default.yaml` with the defaults of all stages, and one YAML file for each preset that differs from it."""
