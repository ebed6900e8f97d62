"""Lets the tests here import `dense_reference.py` beside them by name."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parent))
