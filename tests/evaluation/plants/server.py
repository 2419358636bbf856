"""Server of the cases: ``python -m tests.evaluation.plants.server``.

It reads one JSON request per line from standard input and writes one JSON answer per line to standard output, as
`tests.evaluation.plants.json_server` does. A request has the keys ``half``, ``index``, ``twin`` and ``out``, a folder.
The answer has the keys ``case``, ``twin`` (each with the paths ``robot``, ``a`` and ``b``), ``truth`` and ``seconds``,
or ``error``.
"""

import time
from pathlib import Path

from tests.evaluation.plants.cases import make_case
from tests.evaluation.plants.disk import write_recordings
from tests.evaluation.plants.json_server import Json, serve


def case_request(request: Json) -> Json:
    """Simulate a case, write its files, and return the answer.

    ``request``: request as described in the module's docstring.
    """
    begin, out = time.perf_counter(), Path(request["out"])
    case = make_case(request["half"], int(request["index"]), with_twin=bool(request.get("twin")))
    return {
        "case": write_recordings(case, out, "case"),
        "twin": None if case.twin is None else write_recordings(case.twin, out, "twin"),
        "truth": case.truth_document(),
        "seconds": time.perf_counter() - begin,
    }


if __name__ == "__main__":
    serve(case_request)
