"""The last row of the table of bad input is the sum of the others."""

from __future__ import annotations

import re

from faults import ROOT

ROW = re.compile(r"^\| (.+) \| (\d+) \| (\d+) \| 0 \|$", re.MULTILINE)


def test_total():
    *rows, total = ROW.findall((ROOT / "docs/tests.md").read_text())
    sums = [str(sum(int(row[column]) for row in rows)) for column in (1, 2)]
    assert list(total) == ["all", *sums]
