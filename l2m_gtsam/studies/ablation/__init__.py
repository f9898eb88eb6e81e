"""The ablation study: kinds of maps, densities of fingerprints, closed forms."""
