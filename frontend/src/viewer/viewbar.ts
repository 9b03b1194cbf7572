// The line under the picture: how long a millimetre is, what is on the screen, and how it is looked at.
import { effect, signal } from "@preact/signals-core";
import { find, make } from "../shared/element";
import { numbersOf, type Address } from "./address";
import type { PaintingStage } from "./stage";
import type { Slot, State } from "./state";

const ZOOM_STEP = 1.4;
const QUARTER = 90;
const FIELD = "(max-width: 820px)"; // where the page scrolls, as the style sheet has it
const THUMB = "(pointer: coarse)";

export class ViewBar {
  private readonly percent = make("button", {
    type: "button",
    class: "percent",
    title: "Show one pixel of the picture as one of the screen (0)",
  });
  private readonly byTouch = signal(false);

  constructor(
    host: HTMLElement,
    private readonly stage: PaintingStage,
    address: Address,
  ) {
    const out = quiet("−", "Zoom out", () => stage.zoom(1 / ZOOM_STEP));
    const closer = quiet("+", "Zoom in", () => stage.zoom(ZOOM_STEP));
    const fit = quiet("Fit", "Fit the picture (F)", () => stage.fit());
    const turn = quiet("⟳", "Turn by 90° (T)", () => this.turn(1));
    const touch = quiet(
      "Drag",
      "Drag with one finger: it moves the picture, and no longer the page",
      () => {
        this.byTouch.value = !this.byTouch.value;
      },
    );
    const screen = quiet("", "The whole screen for the picture (W)", () => this.toggleScreen());
    screen.classList.add("screen"); // drawn, as few fonts have a sign for it
    screen.hidden = !document.fullscreenEnabled;
    this.percent.addEventListener("click", () => this.showPixels());
    host.append(out, this.percent, closer, fit, turn, touch, screen);
    this.watchFingers(touch);
    this.register(address);
  }

  /** Turn the pictures by quarters, clockwise. */
  turn(quarters: number): void {
    this.stage.turn(QUARTER * quarters);
  }

  /** Give the picture and its tools the whole screen, or give it back. */
  toggleScreen(): void {
    if (document.fullscreenElement) void document.exitFullscreen();
    else void find("stage").closest(".wall")?.requestFullscreen();
  }

  /** Show one pixel of the picture as one of the screen. */
  showPixels(): void {
    const [x, y] = this.stage.heading;
    this.stage.look(x, y, 1 / devicePixelRatio, false);
  }

  /** Bring the figures in line with the view; call it when that has changed. */
  update(): void {
    const part = 100 * this.stage.left.scale * devicePixelRatio;
    const text = `${part < 10 ? part.toFixed(1) : Math.round(part)} %`;
    if (this.percent.textContent !== text) {
      this.percent.textContent = text;
      this.percent.setAttribute("aria-label", `Zoom ${text}; show pixels one to one`);
    }
  }

  /** On a phone one finger scrolls the page, two move the picture, unless the button says otherwise. */
  private watchFingers(button: HTMLElement): void {
    const [field, thumb] = [matchMedia(FIELD), matchMedia(THUMB)];
    const scrolls = signal(field.matches && thumb.matches);
    const follow = (): void => void (scrolls.value = field.matches && thumb.matches);
    for (const one of [field, thumb]) one.addEventListener("change", follow);
    effect(() => {
      button.hidden = !scrolls.value;
      button.setAttribute("aria-pressed", String(this.byTouch.value));
      this.stage.scrolls = scrolls.value && !this.byTouch.value;
    });
  }

  private register(address: Address): void {
    const { stage } = this;
    address.add({
      carried: true,
      write: (facts) => {
        if (stage.degrees) facts.set("turn", String(stage.degrees));
      },
      read: (facts) => {
        const degrees = numbersOf(facts, "turn", 1)?.[0] ?? 0;
        if (degrees % QUARTER === 0) stage.turnTo(((degrees % 360) + 360) % 360);
      },
    });
  }
}

function quiet(text: string, title: string, act: () => void): HTMLButtonElement {
  const button = make("button", { type: "button", title, "aria-label": title }, text);
  button.addEventListener("click", act);
  return button;
}

/** Say what is on the screen right now, in the line under the picture and above every pane. */
export function sayWhatIsShown(caption: HTMLElement, stage: PaintingStage, state: State): void {
  effect(() => {
    const mode = stage.mode.value;
    const turning = mode === "flicker" || stage.held.value;
    const name = (slot: Slot): string => {
      const choice = state[slot].value;
      return choice ? `${choice.layer.name}, ${choice.picture.label}` : "nothing";
    };
    for (const { slot, label } of stage.cells) {
      label.textContent = `${slot.toUpperCase()}: ${name(slot)}`;
    }
    caption.setAttribute("aria-live", turning ? "off" : "polite");
    caption.dataset["now"] = turning ? stage.inTurn.value : "";
    const [a, b] = [`A: ${name("a")}`, `B: ${name("b")}`];
    const [first, second] = stage.curtain.level.value ? ["above", "below"] : ["left", "right"];
    const share = Math.round(100 * stage.opacity.value);
    const words: Partial<Record<typeof mode, string>> = {
      single: name("a"),
      curtain: `${a} ${first} of the line · ${b} ${second}`.replace("above of", "above"),
      opacity: `${b}, ${share} % over ${a}`,
      difference: `Difference × ${stage.gain.value} of ${a} and ${b}`,
      side: `${a} · ${b}`,
      grid: stage.slots.value.map((slot) => `${slot.toUpperCase()}: ${name(slot)}`).join(" · "),
    };
    caption.textContent = turning
      ? `Now ${stage.inTurn.value === "a" ? a : b}`
      : (words[mode] ?? a);
  });
}
