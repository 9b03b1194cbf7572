// What the server tells, and the few words that the page makes of it.

export type Pair = [number, number, number, number];
export type Point = [number, number];

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
  sensor: string;
  bands: string;
  reference: boolean;
  decision: string;
  reason: string;
  corrections: string;
}

export interface FrameInfo {
  id: string;
  object: string;
  camera: string;
  sensor: string;
  band: string;
  bands: BandInfo[];
  reference: { camera: string; band: string; bands: BandInfo[] };
  is_reference: boolean;
  size: Point;
  target_size: Point;
  px_per_mm: number | null;
  built: boolean;
  builds: number;
  maps: string[];
  method: string;
  verdict: { decision: string; reasons: string[]; next_step: string };
  ladder: Record<string, number>[];
  chosen: string[];
}

export interface Trace {
  largest: Numbers;
  removed: Numbers;
  cut: number;
  scale: [[number, number, number], [number, number, number]];
  order: number;
  centre: Point;
  spread: number;
  rounds: number[];
  /** Coefficients, two for each term, one polynomial after the other. */
  models: Numbers;
  size: Point;
}

/** A column as it came; NaN is what is not known. */
export type Numbers = Float32Array | Float64Array | Int32Array | Uint8Array;

export interface Told {
  version: number;
  /** The version by whose map pictures are brought over. */
  drawn: number;
  places: string;
  pairs: Pair[];
  residual: Numbers;
  leave_one_out: Numbers;
  weight: Numbers;
  state: ("kept" | "removed" | "check")[];
  reason: string[];
  round: Numbers;
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
  trace: Trace | null;
  reject: number;
  stop: number;
  overridden: { reject: boolean; stop: boolean };
  corrections: string;
  note: string;
  can: { undo: number; redo: number };
}

/** An error, as a share of what is tolerated. */
export function shareOf(told: Told, row: number): number {
  const value = told.residual[row]!;
  return value >= 0 ? Math.min(1, value / Math.max(told.stop, 1e-9)) : 0;
}

export interface Partner {
  pair: Pair;
  predicted: Pair;
  shift: Point;
  length: number;
  length_mm: number | null;
  score: number;
  sure: boolean;
}

export const DECISIONS: Record<string, string> = {
  accept: "Can be believed",
  warn: "Believed, but look",
  refuse: "Not believed",
  "not built": "Not built yet",
};

export function px(value: number | null | undefined, digits = 2): string {
  return value === null || value === undefined || !Number.isFinite(value) ? "–" : value.toFixed(digits);
}

/** A length in px, and in mm where the object's size is known. */
export function length(value: number | null | undefined, perMm: number | null, digits = 2): string {
  if (value === null || value === undefined || !Number.isFinite(value)) return "–";
  const mm = perMm ? ` · ${(value / perMm).toFixed(value / perMm < 0.1 ? 3 : 2)} mm` : "";
  return `${value.toFixed(digits)} px${mm}`;
}

/** Green to red for an error, as a share of what is tolerated. */
export function errorColour(value: number | undefined, most: number): string {
  if (value === undefined || Number.isNaN(value)) return "var(--soft)";
  const share = Math.min(1, Math.max(0, value / Math.max(most, 1e-9)));
  return `hsl(${Math.round(130 * (1 - share))} 62% var(--error-light))`;
}
