"""The live canvas: paint traits with the mouse, in a notebook or in a page on this machine.

One `Session` (in ``session.py``, where the protocol stands) serves both; ``widget.py`` carries it
over a notebook's kernel, ``page.py`` over a WebSocket, and ``canvas.js`` is the front end of both.
"""

from __future__ import annotations

import importlib.util
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from traitbrdf.session.editing import EditSession
    from traitbrdf.studio.widget import Canvas


def need_packages() -> None:
    """Raise RuntimeError where a package of the extra "studio" is missing."""
    for name in ("anywidget", "starlette", "uvicorn", "websockets"):
        if importlib.util.find_spec(name) is None:
            raise RuntimeError(
                f"the canvas needs the package {name}, which is missing: "
                'pip install "traitbrdf[studio]"'
            )


def studio(edit: EditSession) -> Canvas:
    """A live canvas over an edit session, for the last line of a notebook cell.

    Parameters
    ----------
    edit : EditSession
        What is painted on. Edits by hand and by code are the same ones: `EditSession.history` has
        them all, and the canvas shows what cells do.

    Returns
    -------
    anywidget.AnyWidget, with the session as ``.session``

    Raises
    ------
    TypeError
        If `edit` is no session.
    RuntimeError
        If the packages of the extra "studio" are not installed.
    """
    need_packages()
    # a notebook's packages take longer to import than all of this one, and so does torch
    from traitbrdf.session.editing import EditSession
    from traitbrdf.studio.widget import Canvas

    if not isinstance(edit, EditSession):
        raise TypeError(f"edit: expected an EditSession, got {edit!r}")
    return Canvas(edit)
