"""Reproduce the paper's success rates: the same as ``l2m study basin``, with its options."""

import sys

from l2m_gtsam.cli.app import main

if __name__ == "__main__":
    sys.argv[1:1] = ["study", "basin"]
    main()
