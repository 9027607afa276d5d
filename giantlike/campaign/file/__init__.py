"""The campaign file: TOML keys, their checks, and the campaign they describe."""
