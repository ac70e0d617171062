"""Contacts of feet whose places are known."""

import numpy as np

from pipeline.avatar.motion.feet import find_contacts

FPS = 30.0


def test_raised_and_fast_soles_do_not_stand() -> None:
    """Heel and ball of the right foot: in the air in the middle, and fast at the end; short gaps are closed."""
    time_s = np.arange(90) / FPS
    soles = np.zeros((90, 4, 3))
    soles[30:60, 2:, 1] = 0.2
    soles[10, 0, 1] = 0.2  # one frame of noise
    soles[60:, 3, 2] = np.linspace(0, 1.0, 30)
    contact = find_contacts(soles, time_s)
    assert contact[:, 0].all()
    assert contact[5:20, 2].all()
    assert not contact[35:55, 2:].any()
    assert contact[70:85, 2].all()
    assert not contact[65:85, 3].any()
