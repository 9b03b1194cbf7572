// Effects of chosen signals alone.
import { effect, untracked, type ReadonlySignal } from "@preact/signals-core";

/** Run an action now and whenever one of some signals changes, whatever else the action reads. */
export function watch(signals: readonly ReadonlySignal<unknown>[], act: () => void): void {
  effect(() => {
    signals.forEach((one) => one.value);
    untracked(act);
  });
}
