// What the page of one object says to its script: the JSON in #record.

export interface Legend {
  entries: { name: string; colour: string }[];
  least: string;
  most: string;
}

export interface Picture {
  key: string;
  label: string;
  kind: "colour" | "light" | "band" | "map" | "mix" | "analysis";
  /** Of a mixture: its red, green and blue part. */
  mixed?: Picture[];
  note: string;
  /** Of a single band: the value that is shown as white; 0 is black. */
  white: number | null;
  legend: Legend | null;
  folder: string;
  width: number;
  height: number;
  tile: number;
  overlap: number;
  format: string;
  least: number;
  most: number;
}

export interface Band {
  label: string;
  wavelength: number | null;
  centroid: number | null;
  fwhm: number | null;
}

export interface SpectraFacts {
  columns: number;
  rows: number;
  width: number;
  height: number;
  bands: number;
  sigma: boolean;
  flags: boolean;
  folder: string;
}

export interface LatticeFacts {
  step: number;
  error: number;
  columns: number;
  rows: number;
  file: string;
}

/** One source of error that pixels share. */
export interface BudgetRow {
  unit: "relative" | "reflectance" | "counts" | "nm" | "sigma";
  /** Standard uncertainty of each band. */
  size: number[];
  /** Whether each line of a scan has a draw of its own. */
  line: boolean;
  /** Value of each band at which the error is nil; 0 where there is none. */
  zero?: number[];
  /** Of a part of sigma: whether every pixel has a draw of its own. */
  pixel?: boolean;
}

/** How well places are known, px: tables on an even lattice over the grid, line by line, and which one is each band's. */
export interface PlaceFacts {
  columns: number;
  rows: number;
  tables: number[][];
  /** −1 of a band whose place is exact, or not known. */
  of: number[];
}

export interface Budget {
  rows: BudgetRow[];
  /** Sources whose size nobody knows. */
  unknown: string[];
  /** Of the noise of a pixel with its neighbours', itself in the middle. */
  correlation: number[][];
  place?: PlaceFacts;
}

export interface Layer {
  id: string;
  name: string;
  camera: string;
  setup: string;
  decision: string;
  unchecked: number;
  verdict: string;
  reasons: string[];
  by_hand: string;
  quantity: string;
  rendering: string;
  bands: Band[];
  pictures: Picture[];
  thumbnail: string;
  spectra: SpectraFacts | null;
  lattice: LatticeFacts | null;
  reference_band: number;
  /** What makes its values uncertain; absent where that is not recorded. */
  budget?: Budget;
}

interface Link {
  title: string;
  href: string;
}

/** One bit of the flags: what it is called and shown by, and whether the value is usable all the same. */
export interface Mark {
  bit: number;
  word: string;
  colour: string;
  trusted: boolean;
}

export interface PageRecord {
  object: { name: string; title: string };
  grid: { width: number; height: number; px_per_mm: number | null };
  reference: string;
  flags: Mark[];
  layers: Layer[];
  links: { sheet: string; report: string; previous: Link | null; next: Link | null };
}

/** The values of every band, of one pixel or of many. */
export interface Spectrum {
  values: Float32Array;
  sigma: Float32Array | null;
  flags: Uint8Array | null;
  /** Of a pixel of a layer whose places are known. */
  slopes?: Gradient | undefined;
}

/** Slopes in x and in y of every band, per px, at a place of the grid, from 0 to 1. */
export interface Gradient {
  x: ArrayLike<number>;
  y: ArrayLike<number>;
  at: [x: number, y: number];
}

/** Shown for a bit that the page's record does not name. */
const UNKNOWN = { word: "unknown flag, not reliable", colour: "#000000", trusted: false };

/** The marks of the bits that are set; a bit without a mark is not to be trusted. */
export function marksOf(bits: number, table: Mark[]): Omit<Mark, "bit">[] {
  const known = table.reduce((sum, mark) => sum | mark.bit, 0);
  return [...table.filter((mark) => bits & mark.bit), ...(bits & ~known ? [UNKNOWN] : [])];
}

/** Read the record that stands in the page. */
export function readRecord(): PageRecord {
  return JSON.parse(document.getElementById("record")?.textContent ?? "") as PageRecord;
}
