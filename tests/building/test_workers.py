"""Objects on workers: the bytes of one process, whatever becomes of a worker; stages here write a line of text (`toy`)."""

import threading
import time

import psutil
import pytest
import toy
from distributed import LocalCluster

from levkas.building import build, status, summarise, workers
from levkas.core.digests import hash_tree
from levkas.core.problems import Refused

NAMES = ("one", "two", "three")


@pytest.fixture
def campaign(tmp_path, toys):
    return toy.make(tmp_path / "campaign", NAMES, ("photo", "colour"))


@pytest.fixture
def cluster():
    with LocalCluster(
        n_workers=2,
        threads_per_worker=1,
        processes=False,
        dashboard_address=None,
        protocol="tcp://",
    ) as made:
        yield made


def test_objects_on_workers_give_the_bytes_of_one_process(campaign, cluster, toys):
    list(build(campaign, output=campaign / "alone"))
    report = summarise(workers.build_on(cluster.scheduler_address, campaign))
    assert report.ok and hash_tree(campaign / "database") == hash_tree(campaign / "alone")
    assert {step.state for step in report.stages} == {"done"}
    assert (
        len({step.key for step in report.stages})
        == len(report.stages)
        == len(status(campaign).stages)
    )
    assert {step.state for step in status(campaign).stages} == {"fresh"}
    toys.computed.clear()
    again = summarise(workers.build_on(cluster.scheduler_address, campaign))
    assert {step.state for step in again.stages} == {"fresh"} and not toys.computed


def test_a_capture_is_refused_on_a_worker_once_and_the_rest_is_built(campaign, cluster, toys):
    toy.spoil(campaign / "colour/one.tif", "register", "E_MATCHES")
    report = summarise(
        workers.build_on(cluster.scheduler_address, campaign, objects=["one", "two"])
    )
    refused = [step for step in report.stages if step.state == "refused"]
    assert [(s.label, s.problems[0].code) for s in refused] == [
        ("one/colour register", "E_MATCHES")
    ]
    assert toys.computed.count("one colour register") == 1
    assert not any(name.startswith("three ") for name in toys.computed)


def test_a_scheduler_without_workers_and_one_that_is_not_there_are_refused(campaign, monkeypatch):
    monkeypatch.setattr(workers, "PATIENCE_S", 0.5)
    with LocalCluster(
        n_workers=0, processes=False, dashboard_address=None, protocol="tcp://"
    ) as none:
        for address in (none.scheduler_address, "tcp://127.0.0.1:9"):
            with pytest.raises(Refused) as refused:
                list(workers.build_on(address, campaign))
            assert (refused.value.problems[0].code, refused.value.problems[0].field) == (
                "E_REMOTE",
                "--workers",
            )


def test_where_the_last_worker_has_gone_the_build_ends_and_is_gone_on_with(
    campaign, cluster, monkeypatch, toys
):
    monkeypatch.setattr(workers, "PATIENCE_S", 1.0)
    steps = workers.build_on(cluster.scheduler_address, campaign)
    with monkeypatch.context() as patch:
        patch.setattr(workers, "_build_object", lambda *asked: time.sleep(5))
        threading.Timer(1.0, cluster.scale, (0,)).start()
        with pytest.raises(Refused) as refused:
            list(steps)
    assert refused.value.problems[0].code == "E_REMOTE"
    assert summarise(build(campaign)).ok


def test_without_the_package_a_sentence_says_what_to_install(campaign, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "distributed", None)
    with pytest.raises(Refused) as refused:
        list(workers.build_on("2", campaign))
    assert "levkas[cluster]" in refused.value.problems[0].fix


@pytest.mark.slow
def test_a_process_that_is_killed_costs_nothing_but_time(make_plates, tmp_path, monkeypatch):
    folder = make_plates(tmp_path / "campaign", ["one", "two"])
    list(build(folder, output=tmp_path / "alone"))
    killed = []

    def kill():
        while not killed:  # as soon as one of them has begun
            time.sleep(0.2)
            for process in psutil.Process().children(recursive=True):
                if any("database" in file.path for file in process.open_files()):
                    killed.append(process.pid)
                    process.kill()
                    break

    real = workers._resources
    monkeypatch.setattr(
        workers, "_resources", lambda *a: threading.Thread(target=kill).start() or real(*a)
    )
    assert summarise(workers.build_on("2", folder)).ok and killed
    assert hash_tree(folder / "database") == hash_tree(tmp_path / "alone")
