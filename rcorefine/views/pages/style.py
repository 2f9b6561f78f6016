"""Style sheet of reports.

It covers light and dark, wide and narrow, screen and paper.
"""

from __future__ import annotations

__all__ = ["STYLE"]

#: Pictures are drawn dark on white. In the dark they are inverted and their hues turned back, so that
#: one picture serves both and curves keep their color.
STYLE = """
:root {
  color-scheme: light dark;
  --page: #ffffff; --text: #1b1e22; --soft: #565d66; --line: #d5d9de; --card: #f5f6f8;
  --accent: #1f4e9c; --found: #9a3b07; --fine: #1b6b34;
}
* { box-sizing: border-box; }
html { -webkit-text-size-adjust: 100%; text-size-adjust: 100%; }
body {
  margin: 0; background: var(--page); color: var(--text);
  font: 17px/1.55 system-ui, -apple-system, "Segoe UI", Roboto, "Liberation Sans", Arial, sans-serif;
  overflow-wrap: break-word;
}
main { max-width: 62rem; margin: 0 auto; padding: 1.6rem 1.2rem 3rem; }
h1 { font-size: 1.7rem; line-height: 1.2; margin: 0 0 .3rem; }
h2 {
  font-size: 1.2rem; margin: 2.4rem 0 .6rem; padding-bottom: .25rem; border-bottom: 1px solid var(--line);
}
p { margin: .55rem 0; max-width: 46rem; }
.about { color: var(--soft); margin: 0; }
.answer {
  margin: 1.2rem 0 0; padding: .9rem 1.2rem; background: var(--card);
  border-left: .35rem solid var(--accent); border-radius: .3rem;
}
.answer.found { border-color: var(--found); }
.answer.fine { border-color: var(--fine); }
.answer p { max-width: none; }
.answer p:first-child { font-size: 1.15rem; font-weight: 600; }
figure { margin: 1.4rem 0; }
figure img { display: block; width: 100%; max-width: 56rem; height: auto; border-radius: .3rem; }
figcaption { color: var(--soft); font-size: .94rem; margin-top: .4rem; max-width: 46rem; }
.scroll { overflow-x: auto; margin: .8rem 0; }
table { border-collapse: collapse; font-size: .94rem; font-variant-numeric: tabular-nums; }
caption { text-align: left; font-weight: 600; padding: .2rem 0 .4rem; }
th, td { padding: .28rem .8rem .28rem 0; border-bottom: 1px solid var(--line); vertical-align: top; }
th { font-weight: 600; border-bottom-color: var(--soft); white-space: nowrap; }
td { min-width: 3.5rem; }
td[style*=right] { white-space: nowrap; }
.notes p { color: var(--soft); font-size: .94rem; }
pre {
  margin: .8rem 0; padding: .8rem 1rem; background: var(--card); border-radius: .3rem; overflow-x: auto;
  font: .84rem/1.45 ui-monospace, "SFMono-Regular", Menlo, Consolas, "Liberation Mono", monospace;
  max-height: 34rem; overflow-y: auto;
}
code { font-family: ui-monospace, "SFMono-Regular", Menlo, Consolas, "Liberation Mono", monospace; }
dl {
  display: grid; grid-template-columns: max-content 1fr; gap: .25rem 1.2rem;
  font-size: .94rem; margin: .8rem 0;
}
dt { color: var(--soft); }
dd { margin: 0; min-width: 0; overflow-wrap: anywhere; }
footer { margin-top: 2.6rem; color: var(--soft); font-size: .88rem; }
@media (max-width: 640px) {
  body { font-size: 16px; }
  main { padding: 1.1rem .8rem 2rem; }
  h1 { font-size: 1.4rem; }
  dl { grid-template-columns: 1fr; gap: 0; }
  dd { margin-bottom: .5rem; }
}
@media screen and (prefers-color-scheme: dark) {
  :root {
    --page: #14171b; --text: #e4e7ea; --soft: #a3abb5; --line: #363c44; --card: #1f242a;
    --accent: #7fa8ec; --found: #ef9a63; --fine: #74c68c;
  }
  figure img { filter: invert(.92) hue-rotate(180deg); }
}
@media print {
  @page { margin: 15mm; }
  body { font-size: 10.5pt; }
  main { max-width: none; padding: 0; }
  figure, tr, .answer { break-inside: avoid; }
  h2 { break-after: avoid; }
  pre { white-space: pre-wrap; overflow-wrap: anywhere; max-height: none; overflow: visible; }
  .scroll { overflow: visible; }
  table { font-size: 9pt; }
}
"""
