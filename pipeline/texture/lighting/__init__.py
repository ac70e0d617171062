"""Light and highlights of a video, told from its frames."""
