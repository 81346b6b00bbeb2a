"""The page about the messages says what they are."""

from __future__ import annotations

import runpy
from pathlib import Path

DOCS = Path(__file__).parents[2] / "docs"


def test_the_page_is_what_the_tables_say():
    page = runpy.run_path(str(DOCS / "write_messages.py"))["page"]
    assert (DOCS / "messages.md").read_text() == page(), "run: python docs/write_messages.py"
