"""Runner of the stages: manifests, locks, strict configuration, progress. Nothing here depends on 3D."""
