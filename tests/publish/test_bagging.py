import bagit
import pytest

import levkas
from levkas.core.digests import hash_tree
from levkas.core.problems import Refused
from levkas.database.validation import validate
from levkas.publish import run


@pytest.fixture
def bagged(database, tmp_path):
    report = run.summarise(run.publish(database, bag=tmp_path / "bag"))
    return report.output, report.bag


def test_the_library_finds_the_bag_valid_and_the_folder_is_what_it_was(bagged):
    folder, bag = bagged
    bagit.Bag(str(bag)).validate()
    assert hash_tree(bag / "data") == hash_tree(folder)
    assert not (folder / "bagit.txt").exists()


def test_a_bag_validates_and_opens_with_levkas(bagged):
    report = validate(bagged[1])
    assert report.ok and report.manifest
    assert list(levkas.open(bagged[1] / "data")) == ["icon1", "icon2"]


def test_a_flipped_bit_in_a_bag_is_found(bagged):
    file = bagged[1] / "data/objects/icon1/icon1_vis.tif"
    data = bytearray(file.read_bytes())
    data[1000] ^= 1
    file.write_bytes(data)
    assert [p.file for p in validate(bagged[1]).problems] == [str(file)]


def test_the_same_publication_gives_the_same_bag(bagged, database, tmp_path):
    list(run.publish(database, bag=tmp_path / "other"))
    assert hash_tree(tmp_path / "other") == hash_tree(bagged[1])
    assert b"Bagging-Date: 2019-06-30" in (bagged[1] / "bag-info.txt").read_bytes()


@pytest.mark.parametrize("where", ["database.published", "database.published/data", "mine"])
def test_no_folder_is_turned_into_a_bag_in_place(database, tmp_path, where):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/thesis.txt").write_text("three years")
    with pytest.raises(Refused) as refused:
        list(run.publish(database, bag=tmp_path / where))
    assert refused.value.problems[0].code == "E_UNWRITABLE"
