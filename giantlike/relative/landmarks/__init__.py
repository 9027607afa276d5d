"""From landmarks on a surface to the body's position: selection, visibility, rendering, matching."""
