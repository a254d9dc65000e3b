"""The modules of this folder, and those of the losses' problems, can be imported."""

import sys
from pathlib import Path

for folder in (Path(__file__).parent, Path(__file__).parents[1] / "objectives"):
    sys.path.insert(0, str(folder))
