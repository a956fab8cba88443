"""Images and videos for people: views, rigs, humans, motions."""
