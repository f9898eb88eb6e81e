"""The harmonic map: potentials that obey Maxwell's equations, tile by tile."""
