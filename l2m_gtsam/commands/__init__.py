"""Groups of commands: parsing and printing only."""
