"""Pages printed to PDF by a browser."""

import os
import shutil
import subprocess
import tempfile
from pathlib import Path

from l2m_gtsam.errors import OutputError
from l2m_gtsam.storage.files import atomic_path

BROWSERS = (
    "chromium",
    "chromium-browser",
    "google-chrome",
    "google-chrome-stable",
    "microsoft-edge",
)
NAMED = "L2M_BROWSER"  # environment variable with another one
TIMEOUT_S = 120


def find_browser() -> str | None:
    """Return the path of a browser that can print, if there is one."""
    names = [os.environ.get(NAMED, ""), *BROWSERS]
    return next((path for name in names if name and (path := shutil.which(name))), None)


def print_page(page: Path, pdf: Path) -> None:
    """Print a page to a PDF.

    Raises
    ------
    OutputError
        There is no browser, or it fails; the line says what to do.
    """
    browser = find_browser()
    if browser is None:
        raise OutputError(
            f"{pdf}: a PDF is printed by Chromium, Chrome or Edge, and none was found: install "
            f"chromium, name one in {NAMED}, or print {page.name} from any browser"
        )
    with tempfile.TemporaryDirectory() as profile, atomic_path(pdf) as temporary:
        run = _run(browser, profile, page, temporary)
        if run or not temporary.stat().st_size:
            raise OutputError(
                f"{pdf}: {browser} could not print {page.name}{run}; print it from any browser"
            )


def _run(browser: str, profile: str, page: Path, pdf: Path) -> str:
    """Return what went wrong, as the end of a sentence."""
    # As root, as in a container, there is no sandbox; the page is ours and has no script.
    command = [
        *(browser, "--headless", "--disable-gpu", "--no-sandbox", f"--user-data-dir={profile}"),
        *("--no-pdf-header-footer", f"--print-to-pdf={pdf}", page.resolve().as_uri()),
    ]
    try:
        # The command is a browser that was found by name, and a page of ours.
        run = subprocess.run(command, capture_output=True, check=False, timeout=TIMEOUT_S)  # noqa: S603
    except subprocess.TimeoutExpired:
        return f" within {TIMEOUT_S} s"
    except OSError as error:
        return f": {error.strerror}"
    return f" (exit code {run.returncode})" if run.returncode else ""
