"""Methods that others published, written from their papers, for comparison."""
