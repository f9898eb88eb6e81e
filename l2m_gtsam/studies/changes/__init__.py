"""Steel that appears, vanishes or moves after a survey: whether it is found, what it costs."""
