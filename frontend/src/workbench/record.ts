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
  maps: string[];
  method: string;
  verdict: { decision: string; reasons: string[]; next_step: string };
  ladder: Record<string, number>[];
  chosen: string[];
}

export interface Trace {
  largest: number[];
  removed: number[];
  cut: number;
  scale: [[number, number, number], [number, number, number]];
  order: number;
  centre: Point;
  spread: number;
  rounds: number[];
  models: [number, number][][];
  size: Point;
}

export interface Told {
  version: number;
  places: string;
  pairs: Pair[];
  residual: (number | null)[];
  leave_one_out: (number | null)[];
  weight: number[];
  state: ("kept" | "removed" | "check")[];
  reason: string[];
  round: number[];
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

/** Numbers as the server packs them: little-endian, in base64. */
interface Packed {
  kind: "f4" | "f8" | "i4";
  shape: number[];
  data: string;
}

interface PackedWords {
  words: string[];
  codes: Packed;
}

type PackedTrace = Omit<Trace, "largest" | "removed" | "models"> & { largest: Packed; removed: Packed; models: Packed };
type Columns = "residual" | "leave_one_out" | "weight" | "round";

/** What the server tells, as it comes. */
export type PackedTold = Omit<Told, Columns | "pairs" | "state" | "reason" | "trace"> & Record<Columns, Packed> & { pairs: Packed | null; state: PackedWords; reason: PackedWords; trace: PackedTrace | null };

/** Unpack what was told; pairs that are not told again are those of `before`. */
export function unpack(told: PackedTold, before: Pair[]): Told {
  const known = (packed: Packed): (number | null)[] => Array.from(numbers(packed), (v) => (Number.isFinite(v) ? v : null));
  const trace = told.trace && {
    ...told.trace,
    largest: Array.from(numbers(told.trace.largest)),
    removed: Array.from(numbers(told.trace.removed)),
    models: inRows(inRows(Array.from(numbers(told.trace.models)), 2), told.trace.models.shape[1]!) as [number, number][][],
  };
  return {
    ...told,
    trace,
    pairs: told.pairs ? (inRows(Array.from(numbers(told.pairs)), 4) as Pair[]) : before,
    residual: known(told.residual),
    leave_one_out: known(told.leave_one_out),
    weight: Array.from(numbers(told.weight)),
    round: Array.from(numbers(told.round)),
    state: words(told.state) as Told["state"],
    reason: words(told.reason),
  };
}

function numbers({ kind, data }: Packed): Float32Array | Float64Array | Int32Array {
  const text = atob(data);
  const bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
  return new { f4: Float32Array, f8: Float64Array, i4: Int32Array }[kind](bytes.buffer);
}

function words({ words, codes }: PackedWords): string[] {
  return Array.from(numbers(codes), (code) => words[code]!);
}

function inRows<T>(values: T[], length: number): T[][] {
  const rows: T[][] = [];
  for (let i = 0; i < values.length; i += length) rows.push(values.slice(i, i + length));
  return rows;
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
export function length(value: number | null, perMm: number | null, digits = 2): string {
  if (value === null || !Number.isFinite(value)) return "–";
  const mm = perMm ? ` · ${(value / perMm).toFixed(value / perMm < 0.1 ? 3 : 2)} mm` : "";
  return `${value.toFixed(digits)} px${mm}`;
}

/** Green to red for an error, as a share of what is tolerated. */
export function errorColour(value: number | null, most: number): string {
  if (value === null) return "var(--soft)";
  const share = Math.min(1, Math.max(0, value / Math.max(most, 1e-9)));
  return `hsl(${Math.round(130 * (1 - share))} 62% var(--error-light))`;
}
