"""Maps that are kept up, piece by piece."""
