"""What the detectors gave, judged before the fit: swapped sides, guessed legs, reliable hands and faces."""
