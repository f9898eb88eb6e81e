"""Commands of ``l2m``, a module each."""
