// What the server answers, and how its numbers are put into words and colours.
import type { Point } from "../shared/pane";

/** A place in the reference and one in the picture to register, px. */
export type Pair = [x: number, y: number, targetX: number, targetY: number];
/** Which half of a pair a picture shows: the index of its x. */
export type Half = 0 | 2;

export interface BandInfo {
  label: string;
  wavelength: number | null;
}

export interface CameraRow {
  id: string;
  object: string;
  title: string;
  camera: string;
  setup: string;
  /** The part of the object that it shows; empty of a camera that shows all of it. */
  tile: string;
  sensor: string;
  bands: string;
  reference: boolean;
  decision: string;
  /** The decision in words. */
  verdict: string;
  reason: string;
  corrections: string;
}

/** Windows of a dense registration, a list a column; px of the reference. */
export interface Windows {
  x: number[];
  y: number[];
  shift_x: number[];
  shift_y: number[];
  sigma: (number | null)[];
  /** How far each lies from a map that was fitted without its part of the picture. */
  held_out: (number | null)[];
  weight: number[];
}

/** What the map of a dense registration rests on. */
export interface Basis {
  /** The band of the windows; "fused" where those of several were put together. */
  source: string;
  /** The band of the checks. */
  band: string;
  count: number;
  windows: Windows;
  checks: {
    x: number[];
    y: number[];
    shift_x: number[];
    shift_y: number[];
    found: boolean[];
    tolerance: number;
  } | null;
}

export interface FrameInfo {
  id: string;
  object: string;
  camera: string;
  sensor: string;
  band: string;
  bands: BandInfo[];
  reference: { camera: string; band: string; bands: BandInfo[] };
  /** Tiles beside which a tile of the reference can be placed, the best first; none of what is placed on the whole reference. */
  beside: { id: string; tile: string; placed: boolean }[];
  is_reference: boolean;
  size: Point;
  target_size: Point;
  px_per_mm: number | null;
  built: boolean;
  builds: number;
  verdict: {
    decision: string;
    words: string;
    reasons: string[];
    next_step: string;
    /** The decision on the layer as a whole, which a person may confirm, and the digest of its map. */
    layer: string;
    map: string;
  };
  /** Degrees clockwise by which the pictures are turned, a multiple of 90. */
  turn: number;
  /** The corrections that the last registration knew; null where nothing says. */
  registered: string | null;
  /** The declared outline that the last registration knew; null where nothing says. */
  registered_outline: Point[] | null;
  /** The outline of the object in campaign.toml; none where it has none. */
  declared_outline: Point[];
  scores: Record<string, number>[];
  chosen: string[];
  basis: Basis | null;
  /** Corners of the object, reference px, within which it was compared; none where the whole frame was. */
  outline: Point[];
}

/** A map target → reference: a polynomial of centred and scaled px. */
export interface Polynomial {
  order: number;
  centre: Point;
  spread: number;
  /** Coefficients, two for each term. */
  terms: number[];
}

/** What a person did to a pair; empty where nothing. */
export type Hand = "" | "added" | "pinned" | "restored" | "deleted" | "checks";

/** The pairs of one camera under correction, and what the fit makes of them. */
export interface SessionState {
  version: number;
  pairs: Pair[];
  /** Px of the reference; null where it is not known. */
  residual: (number | null)[];
  leave_one_out: (number | null)[];
  weight: number[];
  state: ("kept" | "removed" | "check")[];
  hand: Hand[];
  reason: string[];
  /** By which a person knows each pair: it stays while others come and go. */
  number: number[];
  summary: {
    pairs: number;
    kept: number;
    mean: number | null;
    rms: number | null;
    max: number | null;
    leave_one_out: number | null;
    checks: number;
    check_mean: number | null;
    check_max: number | null;
  };
  refusal: string;
  /** By the pairs alone; null where there are too few. */
  map: Polynomial | null;
  stop: number;
  corrections: string;
  /** Whether the layer is placed by the person's pairs alone: "by hand", or empty. */
  accept: "by hand" | "";
  /** Corners of the object, reference px, as a person drew it for all its cameras. */
  outline: Point[];
  can: { undo: number; redo: number };
}

/** The partner of a place in the other picture, as comparing found it. */
export interface Partner {
  pair: Pair;
  predicted: Pair;
  shift: Point;
  length: number;
  length_mm: number | null;
  score: number;
  sure: boolean;
}

/** A pair that is not added yet, and the picture in which it was begun. */
export interface Proposal extends Partner {
  begun: Half;
  /** Whether a person placed the partner, rather than a comparison. */
  placed?: boolean;
}

/** Which pairs the table lists and the pictures show. */
export type Filter = "all" | "kept" | "removed" | "hand";

export function passes({ state, hand }: SessionState, row: number, filter: Filter): boolean {
  if (filter === "hand") return hand[row] !== "" || state[row] === "check";
  return filter === "all" || state[row] === filter;
}

/** Whether the pictures show a pair: those that the table lists, and all check points. */
export function isMarked(session: SessionState, row: number, filter: Filter): boolean {
  return session.state[row] === "check" || passes(session, row, filter);
}

/** A number of pixels; a dash where it is not known. */
export function px(value: number | null | undefined, digits = 2): string {
  return Number.isFinite(value) ? value!.toFixed(digits) : "–";
}

/** A length in px, and in mm where the object's size is known. */
export function length(value: number | null | undefined, perMm: number | null): string {
  if (!Number.isFinite(value)) return "–";
  const mm = perMm ? value! / perMm : 0;
  const added = perMm ? ` · ${mm.toFixed(mm < 0.1 ? 3 : 2)} mm` : "";
  return `${value!.toFixed(2)} px${added}`;
}

/** An error as a share of what is tolerated, 0 to 1; 0 where it is not known. */
export function shareOf({ residual, stop }: SessionState, row: number): number {
  const value = residual[row] ?? -1;
  return value >= 0 ? Math.min(1, value / Math.max(stop, 1e-9)) : 0;
}

/** Green to red for a share of what is tolerated; soft where the error is not known. */
export function errorColour(error: number | null | undefined, tolerated: number): string {
  if (error === undefined || error === null) return "var(--soft)";
  const share = Math.min(1, Math.max(0, error / Math.max(tolerated, 1e-9)));
  return `hsl(${Math.round(130 * (1 - share))} 62% var(--error-light))`;
}
