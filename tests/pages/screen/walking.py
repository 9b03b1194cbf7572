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
