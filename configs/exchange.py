"""JSON-lines server: one request per line on stdin, one answer per line on stdout."""

import json
import os
import sys
import traceback
from collections.abc import Callable
from typing import Any

from armident.configs.errors import ArmidentError

Document = dict[str, Any]


def serve(handle: Callable[[Document], Document]) -> None:
    """Answer every request on stdin with one line on stdout until stdin ends.

    An answer carries the ``id`` of its request. If ``handle`` raises, the answer carries ``error`` instead of results.
    All other output of the process goes to stderr.

    Parameters
    ----------
    handle
        Function from a request to the fields of its answer.
    """
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "w", encoding="utf-8")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    for line in sys.stdin:
        request = json.loads(line)
        try:
            answer = handle(request)
        except ArmidentError as error:
            answer = {"error": f"{type(error).__name__}: {' '.join(str(error).split())}"}
        except Exception as error:
            traceback.print_exc()
            answer = {"error": f"{type(error).__name__}: {' '.join(str(error).split())}"}
        print(json.dumps({"id": request.get("id"), **answer}), file=answers, flush=True)
