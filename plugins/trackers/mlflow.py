"""Every seed as a run of MLflow, in a database beside the results.

    qrlsuite run --task beam6g --model mlp --track mlflow
    mlflow ui --backend-store-uri sqlite:///runs/mlflow.db

All runs of a results folder are in its `mlflow.db`, each task an experiment; with `--track mlflow=DIR`, in
`DIR/mlflow.db`; with `--track mlflow=http://...` or the environment variable `MLFLOW_TRACKING_URI`, on that server.
Steps are epochs, and metrics have their names in TensorBoard.

A resumed run is the same MLflow run. Epochs that come again after a kill are left out, and missing epochs are added
from the run's own records: it has every epoch once.
"""

from __future__ import annotations

import contextlib
import os
import socket
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")  # it would tell MLflow's makers over the network
os.environ.setdefault("MLFLOW_LOGGING_LEVEL", "WARNING")

from mlflow import MlflowClient
from mlflow.entities import Metric, Param
from mlflow.exceptions import MlflowException
from sqlalchemy import event
from sqlalchemy.engine import Engine

from qrlsuite.plugins.trackers import common

TAG = "qrlsuite.id"


class MLflow:
    """Writes MLflow runs, one for each seed.

    Parameters
    ----------
    target:
        A folder for the database, or an MLflow tracking URI; None for the results folder.
    """

    def __init__(self, target: str | None = None) -> None:
        self.folder = Path(target).expanduser() if target and "://" not in target else None
        self.server = None if self.folder else target or os.environ.get("MLFLOW_TRACKING_URI")
        self._clients: dict[str, MlflowClient] = {}
        self._runs: dict[str, tuple[MlflowClient, str]] = {}
        self._logged: dict[str, set[int]] = {}

    def run_started(self, run: Mapping[str, Any]) -> None:
        """Begin or go on with a seed's MLflow run, and add the epochs that it lacks."""
        client = self._client(run)
        experiment = _experiment(client, run["task"])
        name = common.identity(run)
        found = client.search_runs([experiment], f"tags.`{TAG}` = '{name}'", max_results=1)
        logged: set[int] = set()
        if found:
            run_id = found[0].info.run_id
            client.update_run(run_id, status="RUNNING")
            logged |= {metric.step for metric in client.get_metric_history(run_id, "validation/score")}
        else:
            run_id = client.create_run(experiment, tags={TAG: name}, run_name=common.title(run)).info.run_id
            params = [Param(name, str(value)) for name, value in common.settings(run).items()]
            client.log_batch(run_id, params=params)
        self._runs[run["folder"]], self._logged[run["folder"]] = (client, run_id), logged
        for record in run["history"]:
            self.epoch_finished(run, record)

    def epoch_finished(self, run: Mapping[str, Any], record: Mapping[str, Any]) -> None:
        """Log an epoch, all its metrics in one transaction, unless it was logged before."""
        client, run_id = self._runs[run["folder"]]
        epoch, logged = record["epoch"], self._logged[run["folder"]]
        if epoch not in logged:
            now = int(time.time() * 1000)
            metrics = [Metric(name, value, now, epoch) for name, value in common.scalars(record).items()]
            client.log_batch(run_id, metrics=metrics)
            logged.add(epoch)

    def run_finished(self, run: Mapping[str, Any]) -> None:
        """Mark a seed's MLflow run as finished."""
        client, run_id = self._runs.pop(run["folder"])
        client.set_terminated(run_id)

    def _client(self, run: Mapping[str, Any]) -> MlflowClient:
        uri = self.server
        if uri is None:
            folder = self.folder or Path(run["folder"]).parents[2]  # <results>/<task>/<entry>/<seed>
            folder.mkdir(parents=True, exist_ok=True)
            path = folder.absolute() / "mlflow.db"
            if not path.exists():
                _make_database(path)
            uri = f"sqlite:///{path}"
        if uri not in self._clients:
            self._clients[uri] = MlflowClient(tracking_uri=uri)
        return self._clients[uri]


def _make_database(path: Path) -> None:
    """Make an empty database of MLflow.

    MLflow takes a thousand steps, and SQLite forces each to the disk: minutes on a busy one. So it is made beside its
    place without that, and put there as a whole.
    """
    begun = path.with_name(f".{path.name}-{socket.gethostname()}-{os.getpid()}")
    event.listen(Engine, "connect", _without_sync)
    try:
        MlflowClient(tracking_uri=f"sqlite:///{begun}").search_experiments()
        # another worker was first; or there are no hard links here, and MLflow makes it in its place
        with contextlib.suppress(OSError):
            os.link(begun, path)
    finally:
        event.remove(Engine, "connect", _without_sync)
        begun.unlink(missing_ok=True)


def _without_sync(connection: Any, record: Any) -> None:
    connection.execute("PRAGMA synchronous = OFF")


def _experiment(client: MlflowClient, name: str) -> str:
    if (found := client.get_experiment_by_name(name)) is None:
        try:
            return str(client.create_experiment(name))
        except MlflowException:  # another worker was first
            found = client.get_experiment_by_name(name)
            if found is None:
                raise
    return str(found.experiment_id)
