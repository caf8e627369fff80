"""What every page that the program writes needs: a policy that lets nothing else in, and data that
stays data."""

from __future__ import annotations

import base64
import hashlib
import json
from typing import Any


def policy_hash(text: str) -> str:
    """The source of a content security policy that allows exactly this script or style."""
    digest = hashlib.sha256(text.encode("utf-8", "replace")).digest()
    return f"'sha256-{base64.b64encode(digest).decode('ascii')}'"


def script_json(value: Any) -> str:
    """JSON that cannot end the script element that holds it."""
    return json.dumps(value, ensure_ascii=True, allow_nan=False).replace("<", "\\u003c")
