"""Verdicts and sigmas where a drive or its survey is not as assumed."""
