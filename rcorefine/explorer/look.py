"""Style sheet of the explorer, light and dark.

Pictures are inverted in the dark, as in reports.
"""

from __future__ import annotations

_DARK = "@media (prefers-color-scheme: dark)"

#: Of the page: colors that all parts inherit.
PAGE = f"""
:root {{
  color-scheme: light dark;
  --page: #ffffff; --text: #1b1e22; --soft: #565d66; --line: #c9ced4; --card: #f5f6f8; --accent: #1f4e9c;
}}
{_DARK} {{
  :root {{
    --page: #14171b; --text: #e4e7ea; --soft: #a3abb5; --line: #3d444d; --card: #1f242a; --accent: #7fa8ec;
  }}
}}
html, body {{ background: var(--page); color: var(--text); margin: 0; }}
body {{ font: 15px/1.45 system-ui, "Segoe UI", Roboto, "Liberation Sans", Arial, sans-serif; }}
"""

#: Of a picture, drawn dark on white.
PICTURE = f"{_DARK} {{ :host {{ filter: invert(.92) hue-rotate(180deg); }} }}"

#: Two columns where there is room; in one the causes stand between curves and answers.
GRID = """
:host {
  display: grid !important; gap: 0 24px; align-items: start; max-width: 1500px;
  grid-template: "curves causes" auto "answers causes" 1fr / minmax(0, 1fr) minmax(0, 1fr);
}
@media (max-width: 1000px) {
  :host { grid-template: "curves" auto "causes" auto "answers" auto / minmax(0, 1fr); }
}
"""

#: Of text and tables.
TEXT = """
:host { font: inherit; color: var(--text); }
h1 { font-size: 1.4rem; margin: 0; overflow-wrap: anywhere; }
h2 { font-size: 1.05rem; margin: .5rem 0 .2rem; border-bottom: 1px solid var(--line); }
p, summary { margin: .25rem 0; font-size: 1rem; line-height: 1.4; overflow-wrap: anywhere; }
.soft { color: var(--soft); font-size: .92rem; }
.error { font-size: 1.25rem; font-weight: 600; }
.error b { color: var(--accent); font-size: 1.6rem; }
.busy { color: var(--accent); }
.wrong { color: #b5400a; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-size: .9rem; }
caption { text-align: left; font-weight: 600; }
th, td { padding: .15rem .7rem .15rem 0; border-bottom: 1px solid var(--line); text-align: left; }
summary { cursor: pointer; }
summary:focus-visible { outline: 2px solid var(--accent); }
"""

#: Of buttons, fields and sliders.
WIDGET = """
:host { font: inherit; color: var(--text); }
.bk-btn, .bk-btn-default, .bk-btn-primary, a.bk-btn {
  background: var(--card) !important; color: var(--text) !important; border: 1px solid var(--line) !important;
  border-radius: .3rem; text-align: left; white-space: normal; overflow-wrap: anywhere; font-size: .95rem;
  height: auto; min-height: 2rem; padding: .3rem .7rem; line-height: 1.3; text-transform: none;
}
.bk-btn-primary { border-color: var(--accent) !important; box-shadow: inset .25rem 0 0 var(--accent); }
.bk-btn:hover { border-color: var(--accent) !important; }
.bk-btn:focus-visible, .bk-input:focus-visible, .noUi-handle:focus-visible {
  outline: 2px solid var(--accent); outline-offset: 1px;
}
.bk-btn[disabled] { opacity: .55; }
.bk-input, select.bk-input, input.bk-input {
  background-color: var(--page) !important; color: var(--text) !important;
  border-color: var(--line) !important;
}
.bk-slider-title, label { color: var(--text) !important; font-size: .95rem; overflow-wrap: anywhere; }
.noUi-target { background: var(--card); border-color: var(--line); }
.noUi-connect { background: var(--accent); }
"""
