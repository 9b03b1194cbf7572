"""A walk through a page with the Tab key, and what a screen reader is told on the way."""

FOCUSABLE = (
    "button:not([disabled]), a[href], select:not([disabled]), input:not([disabled]), summary,"
    "[tabindex='0']"
)
MARK = """(wanted) => {
  // Of a group of radio buttons only the chosen one is a stop; what is folded away is none.
  document.querySelectorAll('[data-stop]').forEach((e) => { delete e.dataset.stop; });
  const stops = [...document.querySelectorAll(wanted)].filter((e) => e.checkVisibility({visibilityProperty: true})
    && e.tabIndex >= 0 && !e.closest('dialog:not([open])'));
  stops.forEach((e, i) => { e.dataset.stop = i; });
  return stops.length;
}"""
HERE = """() => {
  const e = document.activeElement;
  if (!e || e === document.body) return null;
  const style = getComputedStyle(e), box = e.getBoundingClientRect();
  const around = e.closest('.openseadragon-container')?.parentElement ?? e;
  const outlines = [style, getComputedStyle(around), getComputedStyle(around, '::before'), getComputedStyle(e, '::before')];
  const ring = outlines.some((s) => s.outlineStyle !== 'none' && parseFloat(s.outlineWidth) >= 2)
    || getComputedStyle(e, '::before').backgroundColor === 'rgb(217, 180, 91)';
  const inside = box.bottom > 0 && box.right > 0 && box.top < innerHeight && box.left < innerWidth;
  return {stop: e.dataset.stop ?? null, html: e.outerHTML.slice(0, 120), ring, inside};
}"""
CONTRASTS = """() => {
  const parse = (c) => { const v = c.match(/[\\d.]+(?:e-?\\d+)?/g).map(Number);
    return c.startsWith('color(') ? [255 * v[0], 255 * v[1], 255 * v[2], v[3] ?? 1] : [v[0], v[1], v[2], v[3] ?? 1]; };
  const over = (a, b) => [0, 1, 2].map((i) => a[i] * a[3] + b[i] * (1 - a[3])).concat(1);
  const light = (c) => { const [r, g, b] = c.slice(0, 3).map((v) => v / 255)
    .map((v) => v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4); return 0.2126 * r + 0.7152 * g + 0.0722 * b; };
  const ground = (e, under) => { const chain = [];
    for (let at = e; at; at = at.parentElement) chain.push(parse(getComputedStyle(at).backgroundColor));
    return chain.reverse().reduce((sum, c) => over(c, sum), under); };
  const found = [];
  const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  while (walker.nextNode()) {
    const e = walker.currentNode.parentElement;
    if (!walker.currentNode.data.trim() || !e.checkVisibility({visibilityProperty: true, opacityProperty: true})) continue;
    if (e.closest('script, style, option, [disabled], canvas, .visually-hidden')) continue;
    const style = getComputedStyle(e), size = parseFloat(style.fontSize);
    const large = size >= 24 || (size >= 18.66 && Number(style.fontWeight) >= 700);
    // What lies over a picture may lie over the lightest one.
    const unders = e.closest('.pane, .stage') ? [[255, 255, 255, 1], [0, 0, 0, 1]] : [[255, 255, 255, 1]];
    const own = e.closest('.pane, .stage');
    for (const under of unders) {
      const base = own ? (() => { const chain = []; for (let at = e; at && at !== own; at = at.parentElement) chain.push(parse(getComputedStyle(at).backgroundColor));
        return chain.reverse().reduce((sum, c) => over(c, sum), under); })() : ground(e, under);
      const ink = over(parse(style[e.closest('svg') ? 'fill' : 'color']), base);
      const [a, b] = [light(ink), light(base)];
      const ratio = (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05);
      if (ratio < (large ? 3 : 4.5)) found.push([ratio.toFixed(2), walker.currentNode.data.trim().slice(0, 40), e.className && String(e.className.baseVal ?? e.className)]);
    }
  }
  return found;
}"""


def walk(page, key="Tab"):
    """Press a key until the focus has left the page or come round; return (stops there are, stops met)."""
    count = page.evaluate(MARK, FOCUSABLE)
    page.evaluate(
        "() => { const b = document.body; b.tabIndex = -1; b.focus(); b.removeAttribute('tabindex'); b.blur(); }"
    )
    met = []
    for _ in range(count + 8):
        page.keyboard.press(key)
        here = page.evaluate(HERE)
        if here is None and not met:
            continue  # what had the focus before was the last of all
        if here is None or (met and here["stop"] == met[0]["stop"]):
            break
        met.append(here)
    return count, met


def nameless(page):
    """What a screen reader comes to and cannot name: roles of nodes that take the focus."""
    session = page.context.new_cdp_session(page)
    nodes = session.send("Accessibility.getFullAXTree")["nodes"]
    told = []
    for node in nodes:
        facts = {p["name"]: p["value"].get("value") for p in node.get("properties", [])}
        role = node.get("role", {}).get("value", "")
        if node.get("ignored") or not facts.get("focusable") or role == "RootWebArea":
            continue
        if not node.get("name", {}).get("value", "").strip():
            here = {"backendNodeId": node["backendDOMNodeId"]}
            html = session.send("DOM.getOuterHTML", here)["outerHTML"]
            told.append((role, html[:100]))
    session.detach()
    return told


def faint(page):
    """Texts whose contrast with what is under them is less than WCAG 2.2 asks at level AA."""
    return page.evaluate(CONTRASTS)
