"""Studies: many calibrations whose truth is known, counted."""
