"""Listings of folders as studios leave them, and the campaign that is proposed: a row each."""

import pytest

from levkas.campaign.guess import LookRefused

from .conftest import answered, flat, taken

ONE = "cameras.studio."
ROWS = {
    "a folder a camera and a target": (
        """
        lctf/{dark,white,icon1,icon2}/{450,550,650}nm.tif
        d80/{dark,white,icon1,icon2}/DSC_{0001,0002}.tif | mosaic=1
        45-degree/d80/{white,icon1}/DSC_{0001,0002}.tif | mosaic=1
        """,
        {"campaign.reference.camera": "lctf", "campaign.reference.band": "550 nm",
         "cameras.lctf.kind": "bands", "cameras.lctf.files": "lctf/{target}/{wavelength}nm.tif",
         "cameras.lctf.wavelengths.step": 100, "cameras.lctf.bits": 12, "cameras.d80.kind": "mosaic",
         "targets.dark": "dark", "targets.white": "white",
         "setups.45-degree.cameras.d80.files": "45-degree/d80/{target}/DSC_{shot}.tif"},
        {"icon1/d80", "icon1/d80@45-degree", "icon1/lctf", "icon2/d80", "icon2/lctf"},
    ),
    "everything in the names": (
        "{dark,white,icon1,icon2}-{450,550,650}nm-01.tif",
        {ONE + "files": "{target}-{wavelength}nm-{shot}.tif"}, {"icon1/studio", "icon2/studio"},
    ),
    "plain numbers that all targets have": (
        "{dark,white,icon1,icon2}_{450,550,650}.tif",
        {ONE + "files": "{target}_{wavelength}.tif"}, {"icon1/studio", "icon2/studio"},
    ),
    "plates by wavelengths without darks": (
        "plate{1,2,3}_{450,550}nm.tif", {ONE + "files": "{target}_{wavelength}nm.tif"},
        {"plate1/studio", "plate2/studio", "plate3/studio"},
    ),
    "wavelengths as folders": (
        "{450,550,650}nm/{dark,white,icon1}.tif", {ONE + "files": "{wavelength}nm/{target}.tif"}, {"icon1/studio"},
    ),
    "numbers in unlike steps that darks and whites have, too": (
        "raw/{Weißabgleich=white,Schwarzbild=dark,Büste,Tafel}_W{385,550,940}.tif",
        {ONE + "files": "raw/{target}_W{wavelength}.tif", ONE + "wavelengths": [385, 550, 940]},
        {"Büste/studio", "Tafel/studio"},
    ),
    "words for darks and whites that nobody lists": (
        "{тёмный=dark,белый=white,икона}_{385,550,940}.tif",
        {ONE + "files": "{target}_{wavelength}.tif", "targets.dark": "тёмный", "targets.white": "белый"}, {"икона/studio"},
    ),
    "darks, a white and paintings by their histograms": (
        "IMG_{0000=dark,0001=dark,0002=white,0003=icon,0004=saint}.tif",
        {"targets.dark": ["0000", "0001"], "targets.white": "0002"}, {"0003/studio", "0004/studio"},
    ),
    "names of paintings are no colours": (
        "{dark,white,madonna_nera,bianca}.png", {"targets.dark": "dark"}, {"bianca/studio", "madonna_nera/studio"},
    ),
    "templates in a tree of their own": (
        "images/icon1/{450,550,650}nm.tif\ncalibration/{white,dark}/{450,550,650}nm.tif",
        {"targets.dark": "dark"}, {"icon1/studio"},
    ),
    "flats of two cameras in one folder": (
        "{d80,nir}/{dark,icon}.tif\nflats/{d80=white,nir=white}.tif".replace("{d80,nir}/", "d80/")
        + "\nnir/{dark,icon}.tif | wide=100\nflats/nir.tif | wide=80",
        {"targets.white": "flats", "cameras.d80.files": ["d80/{target}.tif", "{target}/d80.tif"]},
        {"icon/d80", "icon/nir"},
    ),
    "two lightings": (
        "{diffuse=,45deg=}/d80/{dark,white,icon}/001.tif | mosaic=1", {"cameras.d80.kind": "mosaic"},
        {"icon/d80", "icon/d80@45deg"},
    ),
    "photograph, infrared and radiograph of panels": (
        "photo/{panel1,panel2}.jpg\nirr/{panel1,panel2}.tif\nxray/{panel1,panel2}.png | wide=100",
        {"campaign.reference.camera": "photo", "cameras.irr.kind": "image"},
        {f"{p}/{c}" for p in ("panel1", "panel2") for c in ("photo", "irr", "xray")},
    ),
    "kinds of photographs in the names": (
        "{icon,saint_nicholas}_vis.jpg\n{icon,saint_nicholas}_irr.tif", {},
        {f"{o}/{c}" for o in ("icon", "saint_nicholas") for c in ("vis", "irr")},
    ),
    "three pictures alone": ("photo.jpg\nirr.tif\nxray.png", {}, {"studio/irr", "studio/photo", "studio/xray"}),
    "sensors behind one lens, and shots": (
        "msbs/{dark,white,icon}_ccd1_{001,002}.tif | mosaic=1\nmsbs/{dark,white,icon}_ccd2_{001,002}.tif",
        {"cameras.msbs.kind": "sensors", "cameras.msbs.files": "msbs/{target}_{sensor}_{shot}.tif"}, {"icon/msbs"},
    ),
    "lenses of a Sequoia": (
        "IMG_{0000=a,0001=b}_{GRE=,RED=,REG=,NIR=}.TIF",
        {ONE + "kind": "sensors", ONE + "files": "IMG_{target}_{sensor}.TIF"}, {"0000/studio", "0001/studio"},
    ),
    "bands that are counted": (
        "msi/{icon,saint}/band{01,02,03,10}.tif", {"cameras.msi.files": "msi/{target}/{band}.tif"}, {"icon/msi", "saint/msi"},
    ),
    "colours": ("{icon,saint}_{red=,green=,blue=,nir=}.tif", {ONE + "files": "{target}_{band}.tif"}, {"icon/studio", "saint/studio"}),
    "wavelengths between letters": (
        "f12r_{MB365UV=,MB450RB=,MB535Gr=,MB870IR=}_F.tif",
        {ONE + "files": "{target}_MB{wavelength}*_F.tif", ONE + "wavelengths": [365, 450, 535, 870]}, {"f12r/studio"},
    ),
    "elements": ("{icon,saint}_{Pb-L=,Hg-L=,Cu-K=,Fe-K=}.tif", {ONE + "kind": "maps", ONE + "files": "{target}_{band}.tif"},
                 {"icon/studio", "saint/studio"}),
    "tiles as folders": ("photo/icon/r{00,01}c{0,1,2}.jpg", {ONE + "files": "photo/{target}/r{row}c{column}.jpg"}, {"icon/studio"}),
    "tiles in the names": (
        "photo/icon_row{0,1}_col{0,1,2}.jpg", {ONE + "files": "photo/{target}_row{row}_col{column}.jpg"}, {"icon/studio"},
    ),
    "tiles of a microscope": ("photo/icon [Grid@{0,1} {0,1,2}].jpg", {ONE + "files": "photo/{target} [Grid@{row} {column}].jpg"},
                              {"icon/studio"}),
    "one place is a part of a name": ("{icon_r2c3,panel}.jpg", {}, {"icon_r2c3/studio", "panel/studio"}),
    "scans with darks and whites of their own": (
        "{001,002}/{darkref=dark,whiteref=white}.tif\n{001,002}/scan.tif",
        {ONE + "dark": None}, {"001/studio", "002/studio"},
    ),
    "an object under white light is no white": (
        "page_{uv=page,white=page}.jpg", {"targets.white": None}, {"page/uv", "page/white"},
    ),
    "a chart through filters alone": (
        "colorchecker_{450,550,650}nm.png", {ONE + "kind": "bands", "targets.charts.colorchecker": "ColorChecker24"}, set(),
    ),
    "previews, copies and leftovers": (
        """
        {dark,white,icon}_{450,550,650}nm.tif
        icon_{450,550,650}nm.jpg
        previews/icon_{450,550,650}nm.png | wide=60
        {icon_550nm (1),icon_550nm_old,icon_550nm - Copy,test}.tif
        """,
        {ONE + "files": "{target}_{wavelength}nm.tif"}, {"icon/studio"},
    ),
    "twelve bits at the upper end of sixteen": (
        "{dark,white,icon}_{450,550,650}nm.tif | shift=4", {ONE + "saturation": 65520}, {"icon/studio"},
    ),
    "exposures to choose from": (
        "{dark,icon}/{450,550,650}nm_{10,100}ms.tif", {ONE + "exposures": "best"}, {"icon/studio"},
    ),
    "pages of a file": ("nir/{dark,white,icon}.tif | pages=4", {ONE + "kind": "bands"}, {"icon/studio"}),
}  # fmt: skip
SLOW = {
    "words for darks and whites that nobody lists",
    "bands that are counted",
    "pages of a file",
    "two lightings",
}


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.exhaustive] * (name in SLOW)) for name in ROWS]
)
def test_a_folder_is_proposed_as_it_is_and_its_captures_are_found(proposed, name):
    lines, keys, layers = ROWS[name]
    folder, proposal = proposed(lines)
    said = flat(proposal.to_dict())
    only = [key for key in said if key.startswith("cameras.")][:1]
    camera = only[0].split(".")[1] if only else "studio"
    keys = {key.replace(ONE, f"cameras.{camera}."): value for key, value in keys.items()}
    assert {key: said.get(key) for key in keys} == keys
    found = taken(folder, proposal.text)
    assert {f"{name}/{layer}".replace(f"/{camera}", "/studio") if camera != "studio" and f"{name}/studio" in layers
            else f"{name}/{layer}" for name, layer in found} == layers  # fmt: skip


QUESTIONS = {
    "words": ("{alpha=,beta=,gamma=}.tif", [{"studio": 3}, {"alpha": 1, "beta": 1, "gamma": 1}]),
    "letters and numbers": ("page/F{1,2,3}s.png", [{"page": 3}, {"F1s": 1, "F2s": 1, "F3s": 1}]),
    "wavelengths or inventory numbers": ("icon_{365,450,700}.tif", [{"icon": 3}, {"icon": 1}]),
    "the same numbers of two objects": ("{icon,saint}_L{1,2,3}.tif", [{"icon": 3, "saint": 3}, {"icon": 1, "saint": 1}]),
    "paintings by one camera": ("IMG_{0001=a,0002=b,0003=c}.tif", [{"studio": 3}, {"0001": 1, "0002": 1, "0003": 1}]),
}  # fmt: skip


@pytest.mark.parametrize("name", QUESTIONS)
def test_what_names_do_not_decide_is_asked_once_and_each_answer_is_a_campaign(proposed, name):
    lines, answers = QUESTIONS[name]
    folder, proposal = proposed(lines)
    assert sum(bool(camera.choices) for camera in proposal.cameras) == 1
    found = [taken(folder, text) for text in answered(proposal)]
    assert [{key[0]: len(bands) for key, bands in one.items()} for one in found][:2] == answers


def test_folders_of_nothing_to_show_are_refused_with_their_code(studio, tmp_path):
    from levkas.campaign.guess import look

    for lines in ("{dark,white}_{450,550,650}nm.tif", "notes.tif"):
        folder = studio(lines)
        if lines == "notes.tif":
            for path in folder.glob("*.tif"):
                path.write_bytes(b"II*\0junk")
        with pytest.raises(LookRefused) as refused:
            look(folder)
        assert refused.value.problems[0].code == "E_NO_FRAMES"
