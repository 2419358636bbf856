"""Requests and answers as JSON, one a line: how one room works for another as a process."""

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

    An answer carries the ``id`` of its request; if ``handle`` raises, it carries ``error`` instead of results. Whatever
    else the process prints goes to stderr.
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
