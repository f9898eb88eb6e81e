"""Reproduce the paper's Table I: the same as ``l2m study table1``, with its options."""

import sys

from l2m_gtsam.cli.app import main

if __name__ == "__main__":
    sys.argv[1:1] = ["study", "table1"]
    main()
