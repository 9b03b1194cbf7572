"""What a registration leaves behind can be written, read and sent."""

import json
import pickle

import numpy as np

from levkas.core.problems import Problem
from levkas.geometry.transforms import Affine
from levkas.registration.record import COLUMNS, Matches, Registration, RegistrationRefused, Verdict


def test_rows_are_as_the_contract_orders_them():
    matches = Matches.of(
        np.array([[1.0, 2.5], [3, 4]]),
        np.array([[5.0, 6], [7, 8]]),
        residual=np.array([0.25, np.nan]),
        state=np.array(["kept", "removed"], object),
        reason=np.array(["", "too far"], object),
        round=np.array([-1, 3]),
    )
    assert COLUMNS[:4] == ("reference_x", "reference_y", "target_x", "target_y")
    first, second = matches.rows()
    assert first == ("1", "2.5", "5", "6", "0.25", "", "1", "kept", "", "")
    assert second == ("3", "4", "7", "8", "", "", "1", "removed", "too far", "3")
    assert matches.kept.tolist() == [True, False]


def test_a_record_holds_only_what_json_has():
    registration = Registration(
        "levkas",
        {"550 nm": Affine.identity()},
        Verdict("warn", ("why",), "what next", {"miss": np.inf, "n": np.int64(3)}),
        {"mean": np.float32(0.5), "bands": np.array([1.0, np.nan])},
        Matches.of(np.empty((0, 2)), np.empty((0, 2))),
    )
    record = json.loads(json.dumps(registration.to_dict(), allow_nan=False))
    assert record["verdict"]["numbers"] == {"miss": None, "n": 3}
    assert record["errors"] == {"mean": 0.5, "bands": [1.0, None]}
    assert record["trace"] == {}


def test_a_refusal_survives_a_process_boundary():
    refused = RegistrationRefused(Problem("E_MATCHES", "too few"), trace=None)
    again = pickle.loads(pickle.dumps(refused))
    assert again.problems == refused.problems and again.trace is None
