"""From a rendered template to a body's center and range: correlation, and the fit of the template to the pixels."""
