"""From all of a body's light to its center: the moment algorithm, and bodies of a few pixels (unresolved)."""
