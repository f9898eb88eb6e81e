"""Text that strangers wrote, on its way to screens and pictures."""
