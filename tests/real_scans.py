"""Recordings that others have made: they lie beside the repository, in ``../shared/real``."""

from pathlib import Path

import pytest

REAL = Path(__file__).parents[2] / "shared" / "real"
ABSENT = "NOT TESTED on recordings of others:"


def needs(folder):
    """Return a mark that skips where a folder of recordings is absent, and says which."""
    reason = f"{ABSENT} ../shared/real/{folder} is absent"
    return pytest.mark.skipif(not (REAL / folder).is_dir(), reason=reason)


def recordings(folder, pattern):
    """Return parameters of a test: the recordings of a folder, or one that is skipped."""
    if not (REAL / folder).is_dir():
        return [pytest.param(None, marks=needs(folder))]
    files = sorted((REAL / folder).glob(pattern))
    if not files:
        raise FileNotFoundError(f"{REAL / folder} holds no {pattern}.")
    return files
