"""Maps of the magnetic field: the sliding Gaussian process and its slow reference."""
