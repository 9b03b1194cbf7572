"""The page of a camera says what was measured, or that nothing was and what to capture."""

from levkas.pages.camera import CameraReport, render_camera


def test_a_page_of_a_camera_of_which_nothing_is_known_says_what_to_capture():
    empty = render_camera(CameraReport("wheel"))
    assert "Nothing was measured" in empty and "Capture a white" in empty
    row = ["", "0.2", "1.3", "4030", "11.6", "repeated shots"]
    assert "Nothing was measured" not in render_camera(CameraReport("wheel", sensors=[row]))
