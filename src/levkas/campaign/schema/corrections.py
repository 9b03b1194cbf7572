"""The tables of edits.toml: what was corrected by hand, which keys there are, which values they take."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from levkas.campaign.schema.tables import Table
from levkas.campaign.schema.values import Number, Text

MOST_PX = 1e6

Place = Annotated[Number, Field(ge=-MOST_PX, le=MOST_PX)]
Pair = tuple[Place, Place, Place, Place]
Move = tuple[Place, Place, Place, Place, Place, Place, Place, Place]


class FrameKeys(Table):
    """What was corrected of one camera, under one lighting, for one object.

    Pairs are (reference x, reference y, target x, target y); a move is a pair and the pair that
    takes its place.
    """

    deleted: tuple[Pair, ...] = ()
    restored: tuple[Pair, ...] = ()
    pinned: tuple[Pair, ...] = ()
    added: tuple[Pair, ...] = ()
    moved: tuple[Move, ...] = ()
    checks: tuple[Pair, ...] = ()
    reject: Annotated[Number, Field(gt=0)] | None = None
    stop: Annotated[Number, Field(gt=0)] | None = None
    note: Text = ""


class ObjectKeys(Table):
    """What was corrected of one object, by frame name: CAMERA, CAMERA@SETUP, CAMERA:BAND."""

    cameras: dict[str, FrameKeys] = Field(default={})


class EditsDocument(Table):
    """edits.toml as a whole."""

    version: Literal[1]
    objects: dict[str, ObjectKeys] = Field(default={})
