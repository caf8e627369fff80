"""Everything that is drawn: palettes, text and scale bars, image files, video."""
