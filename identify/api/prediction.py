"""Prediction of the torques of a recording by an identified model."""

from pathlib import Path

from armident.identify.api.arguments import Progress, Recorded, Robot, recordings_of, robot_of
from armident.identify.api.identification import Identification
from armident.identify.prediction import TorquePrediction, predict_recording
from armident.identify.saved_model import load_model, model_of


def predict(
    recording: Recorded,
    model: Identification | str | Path,
    robot: Robot | None = None,
    *,
    progress: Progress | None = None,
) -> TorquePrediction:
    """Predict the torques of a recording with an identified model.

    Parameters
    ----------
    recording
        A recording, or the path of one; best one that the model was not identified from.
    model
        An identification, or the path of ``identification.json``, ``diagnosis.json``, or the folder of one.
    robot
        Configuration of the model, or the path or shipped name of one; by default that of the result.
    progress
        Called with the name of a stage and the share done, 0 to 1.

    Returns
    -------
    TorquePrediction
        Measured and predicted torques (M, n), N m or N, and the ``document`` with the errors.

    Raises
    ------
    ConfigError
        If a file does not exist.
    DataError
        If the model is unusable, or the recording is of another robot or too short.

    Examples
    --------
    >>> import armident
    >>> seen, unseen = (armident.simulate_recording("emps", name, seed=1) for name in ("emps_1", "emps_2"))
    >>> armident.predict(unseen, armident.identify(seen, method="idim-ls")).document.held_out
    True
    """
    (read,) = recordings_of(recording)
    config = None if robot is None else robot_of(robot, ())
    if isinstance(model, Identification):
        loaded = model_of(model.document, Path("(in memory)"), config)
    else:
        loaded = load_model(Path(model), config, default=read.robot, progress=progress)
    return predict_recording(read, loaded, progress)
