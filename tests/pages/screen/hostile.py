"""Sixty titles and file names that try to become markup, script, paths or addresses; files of notes that do."""

import json

EVIL = "window.evil=1"
TITLES = [
    f"<script>{EVIL}</script>",
    f"</script><script>{EVIL}</script>",
    f"</title><script>{EVIL}</script>",
    f"</style><script>{EVIL}</script>",
    f"</textarea><script>{EVIL}</script>",
    f"</noscript><img src=x onerror={EVIL}>",
    f"<img src=x onerror={EVIL}>",
    f'"><img src=x onerror={EVIL}>',
    f"'><img src=x onerror={EVIL}>",
    f'" onmouseover="{EVIL}" x="',
    f"' onfocus='{EVIL}' autofocus='",
    f"` onload=`{EVIL}`",
    f"<svg onload={EVIL}>",
    f"<svg><script>{EVIL}</script></svg>",
    f"<svg><animate onbegin={EVIL} attributeName=x dur=1s>",
    f"<math><mi xlink:href='javascript:{EVIL}'>x</mi></math>",
    f"<iframe src=javascript:{EVIL}>",
    f'<iframe srcdoc="<script>parent.{EVIL}</script>">',
    f"<object data=javascript:{EVIL}>",
    f"<embed src=javascript:{EVIL}>",
    f"<details open ontoggle={EVIL}>",
    f"<body onload={EVIL}>",
    f"<input autofocus onfocus={EVIL}>",
    f"<video><source onerror={EVIL}></video>",
    f"<a href=javascript:{EVIL}>click</a>",
    "<base href=http://elsewhere.invalid/>",
    "<meta http-equiv=refresh content='0;url=http://elsewhere.invalid/'>",
    "<link rel=stylesheet href=http://elsewhere.invalid/a.css>",
    "<style>@import url(http://elsewhere.invalid/a.css);</style>",
    "<style>*{display:none}</style>",
    "<form action=http://elsewhere.invalid/><input type=submit>",
    "<template><script>1</script></template>",
    f"<!-- --><script>{EVIL}</script><!-- -->",
    f"<!--><script>{EVIL}</script>",
    f"<![CDATA[<script>{EVIL}</script>]]>",
    f"]]><script>{EVIL}</script>",
    f"&lt;script&gt;{EVIL}&lt;/script&gt;",
    f"&#60;script&#62;{EVIL}&#60;/script&#62;",
    f"\\u003cscript\\u003e{EVIL}\\u003c/script\\u003e",
    f"\\x3cscript\\x3e{EVIL}",
    f"javascript:{EVIL}",
    f"JaVaScRiPt:{EVIL}//",
    f"data:text/html,<script>{EVIL}</script>",
    f"vbscript:{EVIL}",
    "{{ 7 * 7 }}{% raw %}",
    "${7*7}#{7*7}<%= 7*7 %>",
    f"'+({EVIL})+'",
    f'"+({EVIL})+"',
    f"`${{{EVIL}}}`",
    f"'];{EVIL};//",
    f'"}}];{EVIL};//',
    "line\u2028separator\u2029paragraph",
    "right\u202eot tfel\u202c and \u200b\ufeff zero width",
    "..\\..\\windows\\system32",
    "%2e%2e%2f%2e%2e%2fetc%2fpasswd",
    "a?query=1&b=2#fragment",
    "100% %20 %zz + plus",
    '=HYPERLINK("http://elsewhere.invalid")',
    "__proto__",
    "long " * 40,
]


def as_names(titles: list[str]) -> list[str]:
    """Return the titles as names that a file system takes, each unlike the others."""
    names = [t.replace("/", "∕").replace("\0", "")[:60].strip() for t in titles]
    return [name if name not in (".", "..") else f"{name}_" for name in names]


def note(text="A crack", **changes):
    """Return an annotation as the viewer exports it; `changes` replace parts of it by their keys."""
    selector = {"type": "FragmentSelector", "value": "xywh=3,4,5,6"}
    target = {"source": changes.pop("source", CANVAS), "selector": selector}
    body = {"type": "TextualBody", "value": text, "format": "text/plain"}
    made = {"type": "Annotation", "motivation": "commenting", "body": body, "target": target}
    if "selector" in changes:
        target["selector"] = changes.pop("selector")
    return {**made, **changes}


def svg(inner, head='<svg xmlns="http://www.w3.org/2000/svg">'):
    return {"type": "SvgSelector", "value": f"{head}{inner}</svg>"}


def fragment(value):
    return {"type": "FragmentSelector", "value": value}


def page(*items, **changes):
    return json.dumps({"type": "AnnotationPage", "items": list(items), **changes})


CANVAS = "http://localhost:8000/iiif/icon1/canvas"
POLYGON = '<polygon points="1,1 9,1 9,9"/>'
ANNOTATIONS = {
    "a script in the text": page(note(f"<script>{EVIL}</script>")),
    "an image in the text": page(note(f"<img src=x onerror={EVIL}>")),
    "a text that is HTML": page(
        note(body={"type": "TextualBody", "value": "a", "format": "text/html"})
    ),
    "a body elsewhere": page(note(body={"type": "Image", "id": f"javascript:{EVIL}"})),
    "a body that is an address": page(note(body=f"javascript:{EVIL}")),
    "two bodies": page(note(body=[note()["body"], note()["body"]])),
    "no body": page({k: v for k, v in note().items() if k != "body"}),
    "a text that is a number": page(note(7)),
    "a text that is a table": page(note({"toString": "x"})),
    "a text that is too long": page(note("x" * 4001)),
    "control characters": page(note("a\u0000b")),
    "a script in the name": page(note(creator={"type": "Person", "name": f"<svg onload={EVIL}>"})),
    "a name that is a list": page(note(creator=["a", "b"])),
    "a date that is none": page(note(modified=f"javascript:{EVIL}")),
    "a date that is a table": page(note(modified={})),
    "another motivation": page(note(motivation="painting")),
    "another type": page(note(type="Manifest")),
    "svg with onload": page(
        note(selector=svg(POLYGON, f'<svg xmlns="http://www.w3.org/2000/svg" onload="{EVIL}">'))
    ),
    "svg with a script": page(note(selector=svg(f"<script>{EVIL}</script>{POLYGON}"))),
    "a polygon with onclick": page(
        note(selector=svg(f'<polygon points="1,1 9,1 9,9" onclick="{EVIL}"/>'))
    ),
    "a polygon with a style": page(
        note(selector=svg('<polygon points="1,1 9,1 9,9" style="fill:url(//x.invalid)"/>'))
    ),
    "two polygons": page(note(selector=svg(POLYGON * 2))),
    "a path": page(note(selector=svg('<path d="M1,1L9,1L9,9z"/>'))),
    "an animation": page(note(selector=svg(f"<animate onbegin={EVIL}/>"))),
    "a foreign object": page(
        note(selector=svg("<foreignObject><iframe src=//x.invalid/></foreignObject>"))
    ),
    "an entity": page(note(selector=svg(POLYGON, "<!DOCTYPE svg [<!ENTITY a 'b'>]><svg>"))),
    "two corners": page(note(selector=svg('<polygon points="1,1 9,1"/>'))),
    "ten thousand corners": page(note(selector=svg(f'<polygon points="{"1,1 " * 10_000}1,1"/>'))),
    "many spaces": page(note(selector=svg(f'<polygon points="1,1{" " * 7000}"/>'))),
    "a corner outside": page(note(selector=svg('<polygon points="1,1 9,1 9,9999"/>'))),
    "a negative corner": page(note(selector=svg('<polygon points="1,1 9,1 -9,9"/>'))),
    "a corner that is no number": page(note(selector=svg('<polygon points="1,1 9,1 1e9,NaN"/>'))),
    "a circle outside": page(note(selector=svg('<circle cx="999" cy="4" r="2"/>'))),
    "a huge circle": page(note(selector=svg('<circle cx="9" cy="4" r="99999"/>'))),
    "a circle with a fill": page(note(selector=svg('<circle cx="9" cy="4" r="2" fill="red"/>'))),
    "a place outside": page(note(selector=fragment("xywh=9999,4,1,1"))),
    "a rectangle that ends outside": page(note(selector=fragment("xywh=3,4,900,6"))),
    "a negative place": page(note(selector=fragment("xywh=-3,4,5,6"))),
    "numbers without end": page(note(selector=fragment("xywh=" + "9" * 400 + ",4,5,6"))),
    "per cent": page(note(selector=fragment("xywh=percent:1,1,5,5"))),
    "a selector elsewhere": page(note(selector={"type": "XPathSelector", "value": "/html/body"})),
    "a selector that is a list": page(note(selector=[[[]]])),
    "the canvas of another object": page(note(source="http://localhost:8000/iiif/other/canvas")),
    "a canvas that is a script": page(note(source=f"javascript:{EVIL}")),
    "a canvas that climbs": page(note(source="iiif/../canvas")),
    "a canvas of no size": page(note(source={"id": CANVAS, "width": 0, "height": 0})),
    "a canvas of another shape": page(note(source={"id": CANVAS, "width": 5000, "height": 20})),
    "a canvas whose size is a text": page(note(source={"id": CANVAS, "width": "9", "height": 9})),
    "no target": page({k: v for k, v in note().items() if k != "target"}),
    "items that are none": json.dumps({"type": "AnnotationPage", "items": {"length": 9}}),
    "an item that is null": page(None),
    "an item that is a list": page([note()]),
    "too many notes": page(*[note()] * 501),
    "another page": json.dumps({"type": "Manifest", "items": [note()]}),
    "a list": json.dumps([note()]),
    "no JSON": f"<script>{EVIL}</script>",
    "nothing": "",
    "deep brackets": "[" * 100_000,
    "deep tables": page(note(deep=json.loads("[" * 70 + "]" * 70))),
    "three megabytes": page(note("x" * 3_000_000)),
    "__proto__": '{"__proto__": {"type": "AnnotationPage", "items": []}}',
}
