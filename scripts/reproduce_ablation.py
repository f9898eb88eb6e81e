"""Reproduce the paper's ablation: the same as ``l2m study ablation``, with its options."""

import sys

from l2m_gtsam.cli.app import main

if __name__ == "__main__":
    sys.argv[1:1] = ["study", "ablation"]
    main()
