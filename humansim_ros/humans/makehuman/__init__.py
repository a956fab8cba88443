"""Dressed humans from MakeHuman sliders: shape, clothes, hair and textures from its CC0 data."""
