// Which band of a camera is shown in a picture, or which three as red, green and blue.
import { make } from "../element";
import type { BandInfo } from "./record";

const FALSE_COLOUR = "three";
const WANTED_NM = [900, 650, 550]; // of false-colour infrared: red, green, blue

export class BandPicker {
  readonly root = make("div", { class: "bands" });
  /** Numbers of the bands shown, one or three; empty for the one that the registration uses. */
  chosen: number[] = [];
  onChange: () => void = () => {};
  private readonly select = make("select", {});
  private readonly channels: HTMLSelectElement[];
  private bands: BandInfo[] = [];
  private standard = 0;

  constructor(side: string) {
    this.select.setAttribute("aria-label", `Band of the ${side}`);
    this.channels = ["red", "green", "blue"].map((colour) => make("select", { class: colour, "aria-label": `Band shown as ${colour}, ${side}`, hidden: true }));
    this.root.append(this.select, ...this.channels);
    this.select.addEventListener("change", () => this.pick());
    for (const channel of this.channels)
      channel.addEventListener("change", () => {
        this.chosen = this.channels.map((c) => Number(c.value));
        this.onChange();
      });
  }

  /** Offer the bands of a camera; `label` is the one that the registration uses. */
  offer(bands: BandInfo[], label: string): void {
    this.bands = bands;
    this.standard = Math.max(0, bands.findIndex((band) => band.label === label));
    this.chosen = [];
    const options = (): HTMLOptionElement[] => bands.map((band, i) => make("option", { value: i }, band.label));
    this.select.replaceChildren(...options(), ...(bands.length > 1 ? [make("option", { value: FALSE_COLOUR }, "False colour…")] : []));
    this.select.value = String(this.standard);
    for (const channel of this.channels) channel.replaceChildren(...options());
    this.root.hidden = bands.length < 2;
    this.show();
  }

  /** Show the band before or after. */
  step(by: number): void {
    if (this.bands.length < 2) return;
    const now = this.chosen[0] ?? this.standard;
    this.select.value = String((now + by + this.bands.length) % this.bands.length);
    this.pick();
  }

  /** As the server takes it. */
  get query(): string {
    return this.chosen.join(",");
  }

  private pick(): void {
    this.chosen = this.select.value === FALSE_COLOUR ? this.proposed() : [Number(this.select.value)];
    if (this.chosen.length === 1 && this.chosen[0] === this.standard) this.chosen = [];
    this.show();
    this.onChange();
  }

  /** Infrared, red and green by their wavelengths; else the last, the middle and the first band. */
  private proposed(): number[] {
    const last = this.bands.length - 1;
    if (this.bands.some((band) => band.wavelength === null)) return [last, Math.floor(last / 2), 0];
    const nearest = (wanted: number): number => this.bands.reduce((best, band, i) => (Math.abs(band.wavelength! - wanted) < Math.abs(this.bands[best]!.wavelength! - wanted) ? i : best), 0);
    const found = WANTED_NM.map(nearest);
    return new Set(found).size === 3 ? found : [last, Math.floor(last / 2), 0];
  }

  private show(): void {
    const three = this.chosen.length === 3;
    this.channels.forEach((channel, i) => {
      channel.hidden = !three;
      if (three) channel.value = String(this.chosen[i]);
    });
  }
}
