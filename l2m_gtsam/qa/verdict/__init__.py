"""Verdicts: rules that turn figures into reasons, one sentence each."""
