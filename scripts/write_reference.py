"""Write the pages of all options into the documentation."""

from pathlib import Path

from l2m_gtsam.batch.options_text import pages

DOCS = Path(__file__).parents[1] / "docs"

if __name__ == "__main__":
    for path, text in pages().items():
        (DOCS / path).write_text(text, encoding="utf-8")
