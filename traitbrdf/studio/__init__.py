"""The live canvas: paint traits with the mouse, in a notebook or in a page on this machine.

One `Session` (in ``session.py``, where the protocol stands) serves both; ``widget.py`` carries it
over a notebook's kernel, ``page.py`` over a WebSocket, and ``canvas.js`` with ``link.js`` is the
front end of both.
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
    """Return a live canvas over an edit session, for the last line of a notebook cell.

    Parameters
    ----------
    edit : EditSession
        What is painted on. Edits by hand and by code go to the same session: `EditSession.history`
        has them all, and the canvas shows the edits of other cells.

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
    # torch and a notebook's packages take long to import
    from traitbrdf.session.editing import EditSession
    from traitbrdf.studio.widget import Canvas

    if not isinstance(edit, EditSession):
        raise TypeError(f"edit: expected an EditSession, got {edit!r}")
    return Canvas(edit)
