// Which band of a camera is shown in a picture, or which three as red, green and blue.
import { signal } from "@preact/signals-core";
import { make } from "../shared/element";
import { proposeThree } from "../shared/falsecolour";
import type { BandInfo } from "./record";

const FALSE_COLOUR = "three";

export class BandPicker {
  readonly root = make("div", { class: "bands" });
  /** Numbers of the bands shown, one or three; empty for the one that the registration uses. */
  readonly chosen = signal<number[]>([]);
  private readonly select: HTMLSelectElement;
  private readonly channels: HTMLSelectElement[];
  private bands: BandInfo[] = [];
  private standard = 0;

  constructor(side: string) {
    this.select = make("select", { "aria-label": `Band of the ${side}` });
    this.channels = ["red", "green", "blue"].map((ink) =>
      make("select", { class: ink, "aria-label": `Band shown as ${ink}, ${side}`, hidden: true }),
    );
    this.root.append(this.select, ...this.channels);
    this.select.addEventListener("change", () => this.pick());
    for (const channel of this.channels)
      channel.addEventListener("change", () => {
        this.chosen.value = this.channels.map(({ value }) => Number(value));
      });
  }

  /** Offer the bands of a camera; `label` is the one that the registration uses. */
  offer(bands: BandInfo[], label: string): void {
    const at = bands.findIndex((band) => band.label === label);
    [this.bands, this.standard] = [bands, Math.max(0, at)];
    const options = (): HTMLOptionElement[] =>
      bands.map((band, i) => make("option", { value: i }, band.label));
    this.select.replaceChildren(...options());
    if (bands.length > 1)
      this.select.append(make("option", { value: FALSE_COLOUR }, "False colour…"));
    for (const channel of this.channels) channel.replaceChildren(...options());
    this.root.hidden = bands.length < 2;
    this.select.value = String(this.standard);
    this.pick();
  }

  /** Show the band before or after. */
  step(by: number): void {
    if (this.bands.length < 2) return;
    const now = this.chosen.value[0] ?? this.standard;
    this.select.value = String((now + by + this.bands.length) % this.bands.length);
    this.pick();
  }

  /** Show a band by its place in the list, where there is one. */
  show(number: number): void {
    if (this.bands.length < 2 || number >= this.bands.length) return;
    this.select.value = String(number);
    this.pick();
  }

  /** The bands as the server takes them. */
  get query(): string {
    return this.chosen.value.join();
  }

  private pick(): void {
    const three = this.select.value === FALSE_COLOUR;
    const chosen = three
      ? proposeThree(this.bands.map(({ wavelength }) => wavelength))
      : [Number(this.select.value)];
    this.channels.forEach((channel, i) => {
      channel.hidden = !three;
      if (three) channel.value = String(chosen[i]);
    });
    this.chosen.value = chosen.length === 1 && chosen[0] === this.standard ? [] : chosen;
  }
}
