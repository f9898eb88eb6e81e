"""Peers: what a user could do without this project, as rows of the studies' tables."""
