"""How a page looks: light and dark, wide, narrow and on paper."""

STYLE = """
:root { color-scheme: light dark;
  --paper: #fff; --card: #f6f7f9; --ink: #1b1f24; --soft: #57606a; --line: #d5dae0;
  --measured: #57606a; --model: #0b62c4; --command: #9a5b00; --good: #1a6b33; --part: #8a5a00;
  --bad: #b3261e; --warn: #fff4d6; --warn-line: #d39e00; --shade: #0b62c41a; }
@media (prefers-color-scheme: dark) { :root {
  --paper: #14171b; --card: #1d2126; --ink: #e7eaee; --soft: #a4adb8; --line: #3a414a;
  --measured: #b6bec8; --model: #6cb2ff; --command: #f0b35a; --good: #6fd08c; --part: #f0c060;
  --bad: #ff8a80; --warn: #352b10; --warn-line: #d39e00; --shade: #6cb2ff26; } }
* { box-sizing: border-box; }
body { margin: 0 auto; padding: 1rem; max-width: 76rem; background: var(--paper);
  color: var(--ink); font: 16px/1.5 system-ui, sans-serif; overflow-wrap: break-word; }
h1 { font-size: 1.6rem; margin: .3rem 0; line-height: 1.2; }
h2 { font-size: 1.25rem; margin: 2.2rem 0 .5rem; border-bottom: 1px solid var(--line); }
h3 { font-size: 1rem; margin: 1.2rem 0 .4rem; }
p, li, dd { max-width: 46rem; }
a { color: var(--model); }
nav ul { list-style: none; padding: 0; display: flex; flex-wrap: wrap; gap: .2rem 1rem; }
code, pre { font: .9em/1.45 ui-monospace, monospace; }
pre { background: var(--card); padding: .8rem; overflow-x: auto; border-radius: 6px; }
.soft { color: var(--soft); } .small { font-size: .875rem; }
.tiles { display: grid; gap: .7rem; margin: 1rem 0; padding: 0; list-style: none;
  grid-template-columns: repeat(auto-fit, minmax(min(100%, 11rem), 1fr)); }
.tiles li { background: var(--card); border-radius: 6px; padding: .6rem .8rem; }
.tiles b { display: block; font-size: 1.25rem; line-height: 1.3; }
.warning { background: var(--warn); border-left: 5px solid var(--warn-line); margin: .6rem 0;
  padding: .5rem .9rem; border-radius: 4px; break-inside: avoid; }
.warning p { margin: .15rem 0; max-width: none; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; width: 100%; font-size: .9375rem; }
th, td { text-align: left; padding: .35rem .7rem .35rem 0; vertical-align: top;
  border-bottom: 1px solid var(--line); }
thead th { color: var(--soft); font-weight: 600; }
tbody th { font-weight: 600; min-width: 7rem; }
td.number { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap; }
th.number { text-align: right; }
tr.kept td, tr.kept th { font-weight: 700; }
.good { color: var(--good); } .part { color: var(--part); } .bad { color: var(--bad); }
dl.facts { display: grid; gap: .15rem 1rem; margin: 0;
  grid-template-columns: minmax(8rem, max-content) 1fr; }
@media (min-width: 60rem) { dl.facts {
  grid-template-columns: max-content 1fr max-content 1fr; } }
dl.facts dt { color: var(--soft); } dl.facts dd { margin: 0; }
.charts { display: grid; gap: .8rem;
  grid-template-columns: repeat(auto-fill, minmax(min(100%, 22rem), 1fr)); }
figure { margin: 0; background: var(--card); border-radius: 6px; padding: .5rem;
  break-inside: avoid; }
figcaption { font-size: .875rem; color: var(--soft); padding: 0 .3rem .2rem; }
svg.chart { display: block; width: 100%; height: auto; max-width: 30rem; }
img { display: block; max-width: 100%; height: auto; border-radius: 4px; background: #fff; }
svg.bar { width: 10rem; height: 1.5rem; }
svg text { font: 11px system-ui, sans-serif; fill: var(--soft); }
svg .grid { stroke: var(--line); } svg .axis { stroke: var(--soft); }
svg .shade { fill: var(--shade); }
svg .interval { fill: var(--model); opacity: .45; } svg .estimate { fill: var(--model); }
svg .guess { fill: none; stroke: var(--soft); stroke-width: 1.5; }
svg path { fill: none; stroke-width: 1.7; stroke-linejoin: round; }
svg path.measured { stroke: var(--measured); } svg path.model { stroke: var(--model); }
svg path.command { stroke: var(--command); }
svg path.dots { stroke-width: 3; stroke-linecap: round; }
svg path.dots.soft { stroke: var(--measured); opacity: .35; }
svg path.bars { stroke-width: 14; }
svg path.third { stroke: var(--good); }
svg path.dots.third, svg path.dots.command { stroke-width: 8; }
.key.third::before { background: var(--good); }
.key::before { content: ""; display: inline-block; width: .8em; height: .8em; margin-right: .35em;
  border-radius: 50%; background: var(--measured); }
.key.model::before { background: var(--model); }
.key.command::before { background: var(--command); }
.key.shade::before { background: var(--shade); border-radius: 2px; outline: 1px solid var(--line); }
@media (max-width: 60rem) {
  table.stack, table.stack tbody, table.stack tr { display: block; }
  table.stack thead { position: absolute; clip-path: inset(50%); width: 1px; height: 1px;
    overflow: hidden; }
  table.stack tr { background: var(--card); border-radius: 6px; padding: .5rem .8rem;
    margin: .6rem 0; }
  table.stack th, table.stack td { display: grid; grid-template-columns: 8rem 1fr; border: 0;
    padding: .1rem 0; text-align: left; white-space: normal; }
  table.stack tbody th { display: block; font-size: 1.05rem; }
  table.stack td::before { content: attr(data-label); color: var(--soft); font-weight: 400; }
  table.stack td.empty { display: none; } }
@media (max-width: 30rem) {
  table:not(.stack) { font-size: .8125rem; } table:not(.stack) tbody th { min-width: 0; }
  table:not(.stack) :is(th, td) { padding-right: .35rem; } }
@media print {
  :root { color-scheme: light; --paper: #fff; --card: #fff; --ink: #000; --soft: #444;
    --line: #bbb; --measured: #555; --model: #0b62c4; --command: #9a5b00; --good: #1a6b33;
    --part: #8a5a00; --bad: #b3261e; --warn: #fff; --shade: #0b62c41a; }
  body { max-width: none; padding: 0; font-size: 10pt; } nav { display: none; }
  .charts { grid-template-columns: repeat(2, 1fr); } figure { border: 1px solid var(--line); }
  .scroll { overflow: visible; } pre { white-space: pre-wrap; border: 1px solid var(--line); }
  h2, h3 { break-after: avoid; } tr { break-inside: avoid; } }
"""
"""Rules of the page's style; colours have names, so that charts follow the page."""
