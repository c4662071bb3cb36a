"""The page on which a person from elsewhere gives his code: plain HTML, which needs no script."""

from __future__ import annotations

from html import escape

CODE_FIELD = "code"
_STYLE = """
:root { color-scheme: light dark; font-family: system-ui, sans-serif; }
body { margin: 15vh auto; max-width: 22rem; padding: 0 1rem; }
input, button { box-sizing: border-box; width: 100%; font: inherit; padding: 0.75rem; margin: 0.25rem 0; }
input { font-family: ui-monospace, monospace; letter-spacing: 0.1em; text-transform: uppercase; }
.wrong { border-left: 0.3rem solid #c62828; padding-left: 0.7rem; }
"""
_PAGE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>Cockpit: log in</title>
<link rel="stylesheet" href="/login.css">
</head>
<body>
<main>
<h1>Cockpit</h1>
{wrong}<p>On the robot's computer, <code>cocoro cockpit invite operator</code> (or <code>viewer</code>) prints a code.
It is for one login, within ten minutes.</p>
<form method="post" action="/login">
<label for="code">Code</label>
<input id="code" name="{field}" required autofocus autocomplete="one-time-code" autocapitalize="characters"
 spellcheck="false" maxlength="20" placeholder="XXXX-XXXX-XXXX">
<button type="submit">Log in</button>
</form>
<p><a href="/">To the cockpit</a>, if you are logged in already.</p>
</main>
</body>
</html>
"""


def login_page(wrong: str = "") -> bytes:
    """The page; `wrong` is what was wrong with the last attempt."""
    said = f'<p class="wrong" role="alert">{escape(wrong)}</p>\n' if wrong else ""
    return _PAGE.format(wrong=said, field=CODE_FIELD).encode()


def style() -> bytes:
    return _STYLE.encode()
