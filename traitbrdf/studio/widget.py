"""The live canvas in a notebook: `canvas.js` over the kernel's messages."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import anywidget

from traitbrdf.editing import EditSession
from traitbrdf.studio.session import Session


class Canvas(anywidget.AnyWidget):
    """What `traitbrdf.studio` shows; any number of views of it share one `Session`.

    Attributes
    ----------
    session : Session
    """

    _esm = Path(__file__).with_name("canvas.js")

    def __init__(self, edit: EditSession, **settings: Any) -> None:
        super().__init__(**settings)
        self.session = Session(edit)
        self.on_msg(self._answer)
        self.session.subscribe(lambda header, buffers: self.send(header, buffers))

    def _answer(self, widget: object, content: object, buffers: list[Any]) -> None:
        # kernels deliver messages in a thread of their own: the session has a lock
        for header, binary in self.session.handle(content, buffers or ()):
            self.send(header, binary)

    def _repr_mimebundle_(self, **settings: Any) -> Any:
        """The widget, and a still picture for pages that have no kernel."""
        bundle: Any = super()._repr_mimebundle_(**settings)
        still = {"image/png": self.session.still()}
        if bundle is None:
            return still
        if isinstance(bundle, tuple):
            return ({**still, **bundle[0]}, bundle[1])
        return {**still, **bundle}

    def close(self) -> None:
        self.session.close()
        super().close()
