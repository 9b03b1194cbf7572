// The address of a page holds what is shown: each part writes its own fields there, and reads them back.
import type { ReadonlySignal } from "@preact/signals-core";
import type { Range, Slider } from "../shared/controls";
import { watch } from "../shared/watch";

const SAVE_AFTER_MS = 300;

/** What one part of the page keeps in the address. */
export interface Part {
  /** Signals after whose change the address is written anew; other parts call `remember`. */
  signals?: ReadonlySignal<unknown>[];
  /** Whether links to the objects before and after carry it, too: how one looks, not where. */
  carried?: boolean;
  /** Write what is shown. */
  write(facts: URLSearchParams): void;
  /** Show what is written; a field that is not there, or is nonsense, means what a fresh page shows. */
  read(facts: URLSearchParams): void;
}

/** The address of the page of one object; parts are read in the order in which they were added. */
export class Address {
  private readonly parts: Part[] = [];
  private saving = 0;
  private started = false;

  add(part: Part): void {
    this.parts.push(part);
  }

  /** Keep the value of a slider, which calls `remember` itself; that of a fresh page is left out. */
  addSlider(name: string, control: Slider, { value }: Range): void {
    this.add({
      carried: true,
      write: (facts) => {
        if (control.value !== value) facts.set(name, String(control.value));
      },
      read: (facts) => {
        const wanted = numbersOf(facts, name, 1)?.[0] ?? value;
        if (wanted !== control.value) control.set(wanted);
      },
    });
  }

  /** Show what the address holds, now and whenever a link is pasted over it; from then on keep it up to date. */
  start(): void {
    this.recall();
    this.started = true;
    addEventListener("hashchange", () => {
      if (location.hash.includes("=")) this.recall();
    });
    for (const { signals } of this.parts) if (signals) watch(signals, () => this.remember());
  }

  /** Write the address a moment after the last change. */
  remember(): void {
    if (!this.started) return;
    clearTimeout(this.saving);
    this.saving = window.setTimeout(() => this.write(), SAVE_AFTER_MS);
  }

  /** Write the address at once, and return it whole. */
  write(): string {
    clearTimeout(this.saving);
    const [all, carried] = [new URLSearchParams(), new URLSearchParams()];
    for (const part of this.parts) {
      part.write(all);
      if (part.carried) part.write(carried);
    }
    history.replaceState(null, "", `#${all.toString()}`);
    for (const id of ["previous", "next"]) {
      const link = document.getElementById(id);
      if (link instanceof HTMLAnchorElement) link.hash = carried.toString();
    }
    return location.href;
  }

  private recall(): void {
    const facts = new URLSearchParams(location.hash.slice(1));
    for (const part of this.parts) part.read(facts);
  }
}

/** Read some numbers, "1,2.5"; null where the field is not there or has not just `count` numbers. */
export function numbersOf(facts: URLSearchParams, name: string, count: number): number[] | null {
  const values = facts.get(name)?.split(",").map(Number) ?? [];
  return values.length === count && values.every(Number.isFinite) ? values : null;
}
