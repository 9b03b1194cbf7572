// Registered layers of an object, one over another behind a curtain, each with its verdict.
import { make, refill } from "../shared/element";
import type { Layer } from "./session";

export class Curtains {
  readonly root = make("section", { class: "curtains", hidden: true });
  private known = "";

  /** Show what was built; nothing is drawn anew where nothing was. */
  show(layers: Layer[]): void {
    const state = JSON.stringify(layers);
    if (state === this.known) return;
    this.known = state;
    this.root.hidden = !layers.length;
    const objects = [...new Set(layers.map(({ object }) => object))];
    refill(
      this.root,
      make("h2", {}, "Registered so far"),
      ...objects.map((name) => curtainOf(layers.filter(({ object }) => object === name))),
    );
  }
}

function curtainOf(layers: Layer[]): HTMLElement {
  const shown = layers.filter(({ verdict }) => verdict !== "refuse");
  const below = shown.find(({ verdict }) => verdict === "reference") ?? shown[0];
  const rows = layers.map((layer) => {
    const name = layer.setup ? `${layer.camera}@${layer.setup}` : layer.camera;
    const words = [layer.verdict || "unknown", ...layer.reasons.slice(0, 2), layer.next_step];
    const item = make(
      "li",
      { class: layer.verdict },
      make("strong", {}, name),
      " ",
      words.filter(Boolean).join(". "),
    );
    if (layer !== below && shown.includes(layer)) {
      const button = make("button", { type: "button", class: "link" }, "over the reference");
      button.addEventListener("click", () => top.setAttribute("src", address(layer)));
      item.append(" ", button);
    }
    return item;
  });
  const first = shown.find((layer) => layer !== below);
  const top = make("img", {
    class: "top",
    alt: "The layer over the reference",
    src: first ? address(first) : null,
  });
  const slider = make("input", {
    type: "range",
    min: 0,
    max: 100,
    value: 50,
    "aria-label": "Curtain",
  });
  const draw = (): void => {
    top.style.clipPath = `inset(0 0 0 ${slider.value}%)`;
  };
  slider.addEventListener("input", draw);
  draw();
  const pictures = below
    ? make(
        "div",
        { class: "pictures" },
        make("img", { alt: "The reference", src: address(below) }),
        first ? top : null,
      )
    : null;
  return make(
    "div",
    { class: "curtain" },
    make("h3", {}, layers[0]!.object),
    pictures,
    first ? slider : null,
    make("ul", {}, ...rows),
  );
}

function address({ object, camera, setup, built }: Layer): string {
  return `/api/layer?${new URLSearchParams({ object, camera, setup, built: String(built) })}`;
}
