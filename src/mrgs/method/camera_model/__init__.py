"""From what is there to what the scene's cameras write: blur, gains and offsets."""
