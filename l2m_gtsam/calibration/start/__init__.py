"""Initial guesses of the extrinsics, searched for over the whole map."""
