"""A session watched while it lasts: the folder's frames, their findings, what is missing, a page that follows them."""

from levkas.workbench.watching.session import SessionState, WatchedSession

__all__ = ["SessionState", "WatchedSession"]
