"""The live canvas in a notebook: `canvas.js` over the kernel's messages.

A message of a kernel passes a server and wakes all that watches the kernel, which takes longer than
a frame. So where browser and kernel are on one machine, the page is offered a socket of its own;
where it cannot be opened, messages go on.
"""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import anywidget

from traitbrdf.session.editing import EditSession
from traitbrdf.studio.page import Server
from traitbrdf.studio.session import Session

_FILES = ("link.js", "canvas.js")


def _module() -> str:
    """Return the front end as one module: notebooks load no second one beside it."""
    link, canvas = (Path(__file__).with_name(name).read_text("utf-8") for name in _FILES)
    return link + "".join(line for line in canvas.splitlines(True) if '"./link.js"' not in line)


class Canvas(anywidget.AnyWidget):
    """The widget that `traitbrdf.studio` shows; all views of it share one `Session`.

    Parameters
    ----------
    edit : EditSession
    **settings
        Passed to `anywidget.AnyWidget`.

    Attributes
    ----------
    session : Session
    server : Server or None
        Gives pages on this machine a socket, once one has asked for it.
    """

    _esm = _module()

    def __init__(self, edit: EditSession, **settings: Any) -> None:
        super().__init__(**settings)
        self.session = Session(edit)
        self.server: Server | None = None
        self.on_msg(self._answer)
        self.session.subscribe(lambda header, buffers: self.send(header, buffers))

    def _answer(self, widget: object, content: object, buffers: list[Any]) -> None:
        # kernels deliver messages in a thread of their own: the session has a lock
        for header, binary in self.session.handle(content, buffers or ()):
            if isinstance(content, dict) and header["kind"] == "frame" and "origin" in content:
                header["socket"] = self._socket(content["origin"])
            self.send(header, binary)

    def _socket(self, origin: object) -> str | None:
        """Return the address of a socket, if the page's address is one of this machine."""
        if not isinstance(origin, str) or len(origin) > 100:
            return None
        if urlsplit(origin).hostname not in ("127.0.0.1", "localhost"):
            return None
        if self.server is None:
            try:
                self.server = Server(self.session)
            except OSError:  # a machine without sockets
                return None
            threading.Thread(target=self.server.run, name="traitbrdf-page", daemon=True).start()
        self.server.origins.add(origin)
        return self.server.socket_url

    def _repr_mimebundle_(self, **settings: Any) -> Any:
        """Return the widget, and a still picture for pages without a kernel."""
        bundle: Any = super()._repr_mimebundle_(**settings)
        still = {"image/png": self.session.still()}
        if bundle is None:
            return still
        if isinstance(bundle, tuple):
            return ({**still, **bundle[0]}, bundle[1])
        return {**still, **bundle}

    def close(self) -> None:
        """End the widget, its server and its session."""
        if self.server is not None:
            self.server.stop()
        self.session.close()
        super().close()
