"""How long a training takes until its model is good: processor seconds and minutes to a given
quality, for methods, presets and commits in turns."""
