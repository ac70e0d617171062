"""Priors of the fit: pose, joint limits, motion and shape of anyone, and the posture of the recording."""
