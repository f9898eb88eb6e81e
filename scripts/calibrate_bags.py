"""Calibrate a folder or a manifest of bags: the same as ``l2m batch``, with its options."""

import sys

from l2m_gtsam.cli.app import main

if __name__ == "__main__":
    sys.argv[1:1] = ["batch"]
    main()
