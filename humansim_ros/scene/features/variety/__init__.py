"""Random people: bodies, outfits, motions and places from a seed."""
