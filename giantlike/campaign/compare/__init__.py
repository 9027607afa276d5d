"""A run beside another, or beside what another team has: differences over combined sigma, errors that both share."""
