"""Checkpoint file of an unfinished training: the state of the trainer and the seconds it took."""

from pathlib import Path

from pipeline.field.trainer import Trainer
from pipeline.io.tensors import load_tensors, save_tensors

CHECKPOINT_FILE = "checkpoint.safetensors"


def save_checkpoint(path: Path, trainer: Trainer, seconds: float) -> None:
    """Write the trainer's state and the training time so far, s."""
    save_tensors(path, trainer.state_dict(), {"seconds": seconds})


def load_checkpoint(path: Path, trainer: Trainer) -> float:
    """Restore the trainer from a checkpoint and return its training time, s; 0 if there is no checkpoint.

    Raises:
        UserError: the file cannot be read.
    """
    if not path.exists():
        return 0.0
    tensors, description = load_tensors(path)
    trainer.load_state_dict(tensors)
    return float(description["seconds"])
