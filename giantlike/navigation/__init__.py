"""What comes after single images: passes, filters, covariance analysis, positions from several bodies."""

__all__: list[str] = []
