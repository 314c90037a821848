"""What a host program may have set, and what our code needs: neither is changed for the other.

A host may let numpy raise on underflow, may have another default device or inference mode of torch,
and may fork. Public classes and functions are `steady`: they run under numpy's defaults and on
torch's usual device, in the calling thread alone. Tensors name their type, because the default one
cannot be set for a thread.
"""

from __future__ import annotations

import functools
import inspect
import os
import sys
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any, TypeVar, cast

import numpy as np

_T = TypeVar("_T")

_NUMPY: dict[str, Any] = {"divide": "warn", "over": "warn", "under": "ignore", "invalid": "warn"}

_threads = {"started": False, "lost": False}
"""Whether this process has computed in threads, and whether it was forked from one that had."""


def _after_fork() -> None:
    _threads["lost"] |= _threads["started"]


if hasattr(os, "register_at_fork"):  # not on Windows
    os.register_at_fork(after_in_child=_after_fork)


def steady(what: _T) -> _T:
    """Make a function, or the public methods of a class, independent of the host's settings.

    Parameters
    ----------
    what : function or class
        A class is changed in place.

    Returns
    -------
    The class, or a function of the same signature.
    """
    return cast(_T, _steady(what, False))


def steady_in_threads(what: _T) -> _T:
    """Make it `steady`, and refuse to run in a process that was forked after it had run before.

    Parameters
    ----------
    what : function or class
        It may compute in several threads, which a fork does not copy: it would wait for them
        forever. The RuntimeError says how to start processes instead.
    """
    return cast(_T, _steady(what, True))


def _steady(what: Any, threads: bool) -> Any:
    if not inspect.isclass(what):
        return _wrapped(what, threads)
    for name, value in list(vars(what).items()):
        if name.startswith("_") and name not in ("__init__", "__getitem__", "__call__"):
            continue
        if isinstance(value, (classmethod, staticmethod)):
            setattr(what, name, type(value)(_wrapped(value.__func__, threads)))
        elif isinstance(value, property) and value.fget is not None:
            setter = None if value.fset is None else _wrapped(value.fset, threads)
            setattr(what, name, property(_wrapped(value.fget, threads), setter, value.fdel))
        elif inspect.isfunction(value):
            setattr(what, name, _wrapped(value, threads))
    return what


def _wrapped(function: Callable[..., Any], threads: bool) -> Callable[..., Any]:
    @functools.wraps(function)
    def run(*args: Any, **kwargs: Any) -> Any:
        if threads:
            if _threads["lost"]:
                raise RuntimeError(
                    "this process was forked from one that had rendered, and the threads that "
                    "render are not copied: start it by multiprocessing.get_context('spawn')"
                )
            _threads["started"] = True
        torch = sys.modules.get("torch")
        # what needs no change costs next to nothing
        if np.geterr() == _NUMPY and (torch is None or _usual(torch)):
            return function(*args, **kwargs)
        with ExitStack() as stack:
            stack.enter_context(np.errstate(**_NUMPY))
            if torch is not None:
                if torch.is_inference_mode_enabled():
                    stack.enter_context(torch.inference_mode(False))
                if torch.get_default_device().type != "cpu":
                    stack.enter_context(torch.device("cpu"))
            return function(*args, **kwargs)

    return run


def _usual(torch: Any) -> bool:
    return not torch.is_inference_mode_enabled() and torch.get_default_device().type == "cpu"
