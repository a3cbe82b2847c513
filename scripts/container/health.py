"""Check whether a live page answers on this machine: exit code 0 or 1. Usage: python health.py PORT."""

import sys
import urllib.error
import urllib.request

ASKS_FOR_TOKEN = 401  # the page is up, and wants a token


def answers(port: int, seconds: float = 3.0) -> bool:
    """Tell whether the page answers."""
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/", timeout=seconds) as answer:
            return bool(answer.status == 200)
    except urllib.error.HTTPError as error:
        return error.code == ASKS_FOR_TOKEN
    except OSError:
        return False


if __name__ == "__main__":
    sys.exit(not answers(int(sys.argv[1])))
