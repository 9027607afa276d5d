"""Control networks: adjustment, rotation, reliability."""
