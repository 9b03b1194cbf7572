"""Methods that compare grey values: elastix, SimpleITK and ANTs, as their users run them.

All start from the scale alone, on the target laid on the reference's pixels; settings are those of
the packages' own examples for a multimodal pair, an affine map first and a smooth field after it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas_peers.pair import Answer, NoAnswer

if TYPE_CHECKING:
    from levkas_peers.pair import Pair

LEVELS = 4
"""Of the pyramid of elastix."""
NODE_PX = 64
"""Distance of the nodes of B-spline fields, px."""
MATTES_BINS = 48


def elastix(pair: Pair) -> Answer:
    """Elastix's default affine and B-spline maps, mutual information, four levels."""
    import itk

    moved, _ = pair.moved()
    fixed, moving = (
        itk.image_view_from_array(np.ascontiguousarray(p)) for p in (pair.reference, moved)
    )
    parameters = itk.ParameterObject.New()
    for kind in ("affine", "bspline"):
        chosen = parameters.GetDefaultParameterMap(kind, LEVELS)
        chosen["MaximumNumberOfIterations"] = ["500"]
        chosen["NumberOfSpatialSamples"] = ["4000"]
        chosen["RandomSeed"] = ["121212"]
        if kind == "bspline":
            chosen["FinalGridSpacingInPhysicalUnits"] = [str(float(NODE_PX))]
        parameters.AddParameterMap(chosen)
    try:
        _, found = itk.elastix_registration_method(
            fixed, moving, parameter_object=parameters, log_to_console=False
        )
        field = itk.array_from_image(itk.transformix_deformation_field(moving, found))
    except RuntimeError as error:
        raise NoAnswer(str(error).strip().splitlines()[-1][-160:]) from error
    return Answer(_after(Displacement(np.asarray(field, float)[..., :2]), pair), "affine, B-spline")


def simpleitk(pair: Pair) -> Answer:
    """SimpleITK: Mattes mutual information, an affine map, then B-splines by L-BFGS-B."""
    import SimpleITK as sitk

    moved, _ = pair.moved()
    fixed, moving = (
        sitk.GetImageFromArray(np.asarray(p, np.float32)) for p in (pair.reference, moved)
    )
    height, width = moved.shape
    affine = sitk.AffineTransform(2)
    affine.SetCenter([(width - 1) / 2, (height - 1) / 2])
    nodes = [max(2, round(side / NODE_PX)) for side in (width, height)]
    spline = sitk.BSplineTransformInitializer(fixed, nodes, 3)
    try:
        _mattes(sitk, fixed, moving, affine, None)
        _mattes(sitk, fixed, moving, spline, affine)
    except RuntimeError as error:
        raise NoAnswer(str(error).strip().splitlines()[-1][-160:]) from error
    both = sitk.CompositeTransform([affine, spline])
    field = sitk.TransformToDisplacementField(
        both,
        sitk.sitkVectorFloat64,
        fixed.GetSize(),
        fixed.GetOrigin(),
        fixed.GetSpacing(),
        fixed.GetDirection(),
    )
    return Answer(_after(Displacement(sitk.GetArrayFromImage(field)), pair), "affine, B-spline")


def _mattes(sitk: Any, fixed: Any, moving: Any, transform: Any, before: Any) -> None:
    run = sitk.ImageRegistrationMethod()
    run.SetMetricAsMattesMutualInformation(MATTES_BINS)
    run.SetMetricSamplingStrategy(run.REGULAR)
    run.SetMetricSamplingPercentage(0.2)
    run.SetInterpolator(sitk.sitkLinear)
    run.SetShrinkFactorsPerLevel([8, 4, 2, 1])
    run.SetSmoothingSigmasPerLevel([4, 2, 1, 0.5])
    if before is None:
        run.SetOptimizerAsRegularStepGradientDescent(1.0, 1e-4, 200)
        run.SetOptimizerScalesFromPhysicalShift()
    else:
        run.SetMovingInitialTransform(before)
        run.SetOptimizerAsLBFGSB(numberOfIterations=60)
    run.SetInitialTransform(transform, inPlace=True)
    run.Execute(fixed, moving)


def ants(pair: Pair) -> Answer:
    """ANTs' SyN with an aggressive affine start, mutual information."""
    import ants as antspy
    import pandas

    moved, _ = pair.moved()
    fixed, moving = (antspy.from_numpy(np.ascontiguousarray(p.T)) for p in (pair.reference, moved))
    try:
        found = antspy.registration(fixed, moving, type_of_transform="SyNAggro", random_seed=1)
    except (RuntimeError, ValueError) as error:
        raise NoAnswer(str(error)[-160:]) from error

    def forward(points: np.ndarray) -> np.ndarray:
        table = pandas.DataFrame({"x": points[:, 0], "y": points[:, 1]})
        out = antspy.apply_transforms_to_points(2, table, found["fwdtransforms"])
        return np.asarray(out[["x", "y"]], float)

    y, x = np.mgrid[: moved.shape[0], : moved.shape[1]].astype(float)
    places = np.stack([x.ravel(), y.ravel()], 1)
    field = (forward(places) - places).reshape(*moved.shape, 2)
    return Answer(_after(Displacement(field), pair), "SyN")


def _after(field: Displacement, pair: Pair) -> Any:
    return lambda points: pair.start(field(points))


@dataclass(frozen=True, eq=False)
class Displacement:
    """``p ↦ p + field(p)``, linear between pixels, constant beyond the edge.

    Parameters
    ----------
    field : ndarray, (h, w, 2), px
        Shift in x and y at every pixel.

    Examples
    --------
    >>> Displacement(np.full((3, 3, 2), 0.5))(np.array([[1.25, 2.0]]))
    array([[1.75, 2.5 ]])
    """

    field: np.ndarray

    def __call__(self, points: np.ndarray) -> np.ndarray:
        from scipy.ndimage import map_coordinates

        points = np.asarray(points, float)
        places = points[:, ::-1].T
        shift = [
            map_coordinates(self.field[..., k], places, order=1, mode="nearest") for k in (0, 1)
        ]
        return points + np.stack(shift, 1)
