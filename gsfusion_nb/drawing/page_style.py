"""Looks of the report page: one style sheet for light and dark, wide and narrow, and the click-to-enlarge script."""

STYLE = """
:root{--bg:#f5f6f8;--card:#fff;--ink:#1c2430;--muted:#5c6675;--line:#dfe4ea;--accent:#2f6fb5;--accent-soft:#e7f0f9;
--held:#8a4b08;--held-soft:#fdf0df;--warn:#8a4b08;--warn-soft:#fff4e2;--warn-line:#f0c98b;color-scheme:light dark}
@media (prefers-color-scheme:dark){:root{--bg:#11151a;--card:#1a2028;--ink:#e7ebf0;--muted:#9aa5b4;--line:#2e3743;
--accent:#7db3e8;--accent-soft:#1d3044;--held:#f0b56b;--held-soft:#3a2a14;--warn:#f3c07c;--warn-soft:#33260f;
--warn-line:#6a4e20}}
*{box-sizing:border-box}
body{margin:0;background:var(--bg);color:var(--ink);font:15px/1.5 system-ui,-apple-system,"Segoe UI",Roboto,
"Helvetica Neue",Arial,"Liberation Sans",sans-serif;-webkit-text-size-adjust:100%}
main{max-width:1160px;margin:0 auto;padding:36px 24px 64px}
h1{font-size:1.9rem;line-height:1.2;margin:0 0 4px;letter-spacing:-.015em;overflow-wrap:anywhere}
h2{font-size:1.2rem;margin:44px 0 4px;letter-spacing:-.01em}
h3{font-size:1rem;margin:0;overflow-wrap:anywhere}
p{margin:0 0 12px;max-width:100ch}
.lead,.note{color:var(--muted)}.note{font-size:.9rem}
.card{background:var(--card);border:1px solid var(--line);border-radius:10px;padding:16px 18px;min-width:0}
.warn{background:var(--warn-soft);border:1px solid var(--warn-line);color:var(--warn);border-radius:10px;
padding:10px 16px;margin:14px 0 0;overflow-wrap:anywhere}
.grid{display:grid;gap:14px}
.hero{grid-template-columns:repeat(6,minmax(0,1fr));margin-top:22px}
.hero .label{color:var(--muted);font-size:.85rem;white-space:nowrap}
.hero .value{font-size:1.75rem;line-height:1.25;font-weight:640;letter-spacing:-.02em;font-variant-numeric:tabular-nums;
white-space:nowrap}
.hero .value small{font-size:.95rem;font-weight:500;color:var(--muted);letter-spacing:0}
.hero .more{color:var(--muted);font-size:.82rem;overflow-wrap:anywhere}
.missing{color:var(--muted);font-style:italic;overflow-wrap:anywhere}
.hero .missing{font-size:.9rem;font-weight:400;white-space:normal;letter-spacing:0}
.two{grid-template-columns:repeat(auto-fit,minmax(min(100%,440px),1fr));margin-top:12px}
.two>.card:not(.chart):last-child:nth-child(odd){grid-column:1/-1}
.view{margin-top:14px}.view-head{display:flex;flex-wrap:wrap;gap:4px 12px;align-items:baseline;margin-bottom:10px}
.view-head .score{margin-left:auto;color:var(--muted);font-variant-numeric:tabular-nums}
.chip{font-size:.78rem;font-weight:600;padding:1px 9px;border-radius:99px;background:var(--accent-soft);
color:var(--accent);white-space:nowrap}
.chip.held{background:var(--held-soft);color:var(--held)}
.pictures{display:grid;grid-template-columns:repeat(3,minmax(0,1fr));gap:12px}
.pictures.few{grid-template-columns:repeat(auto-fit,minmax(min(100%,300px),1fr))}
figure{margin:0;min-width:0}
figure img{display:block;width:100%;height:auto;border-radius:6px;background:var(--line);cursor:zoom-in}
figcaption{font-size:.85rem;color:var(--muted);margin-top:4px;line-height:1.35}
.bar{height:8px;border-radius:3px;margin-top:6px}
.ends{display:flex;justify-content:space-between;font-size:.78rem;color:var(--muted);font-variant-numeric:tabular-nums}
.chart svg{display:block;width:100%;height:auto}
.chart svg text{font-family:system-ui,-apple-system,"Segoe UI",Roboto,Arial,"Liberation Sans",sans-serif!important}
.chart h3{margin-bottom:6px}
table{border-collapse:collapse;width:100%;font-size:.92rem}
td,th{padding:5px 10px 5px 0;border-top:1px solid var(--line);text-align:left;vertical-align:top;overflow-wrap:anywhere}
tr:first-child>td,tr:first-child>th{border-top:0}
th{font-weight:600;color:var(--muted)}
td.num{white-space:nowrap}
td.num,th.num{text-align:right;font-variant-numeric:tabular-nums;padding-right:0;padding-left:14px;overflow-wrap:normal}
.card h3+table{margin-top:6px}
.what{display:block;color:var(--muted);font-size:.82rem;line-height:1.35}
code{font:.88em ui-monospace,SFMono-Regular,Menlo,Consolas,"Liberation Mono",monospace;overflow-wrap:anywhere}
details>summary{cursor:pointer;font-weight:600;font-size:1.2rem;margin:44px 0 12px;letter-spacing:-.01em}
.columns{columns:2;column-gap:36px}.columns>div{display:flex;gap:12px;justify-content:space-between;align-items:baseline;
border-bottom:1px solid var(--line);padding:4px 0;break-inside:avoid;font-size:.9rem}
.files td:first-child{white-space:nowrap;padding-right:20px}
.columns .v{text-align:right;font-variant-numeric:tabular-nums;overflow-wrap:anywhere;min-width:30%}
.scroll{overflow:auto;max-height:520px}
.scroll table{white-space:nowrap}.scroll thead th{position:sticky;top:0;background:var(--card);border-top:0;
box-shadow:0 1px var(--line)}
dialog{padding:0;border:0;background:transparent;max-width:96vw;max-height:96vh}
dialog::backdrop{background:rgba(0,0,0,.82)}
dialog img{display:block;width:min(96vw,1600px);max-height:96vh;object-fit:contain;cursor:zoom-out}
@media (max-width:1080px){.hero{grid-template-columns:repeat(3,minmax(0,1fr))}}
@media (max-width:720px){main{padding:22px 12px 40px}h1{font-size:1.5rem}.card{padding:12px 12px}
.hero{grid-template-columns:repeat(2,minmax(0,1fr));gap:10px}.hero .value{font-size:1.4rem}
.pictures{grid-template-columns:repeat(2,minmax(0,1fr));gap:10px}.error{order:1}.columns{columns:1}
.view-head .score{margin-left:0;width:100%}h2,details>summary{margin-top:32px}}
@media print{body{background:#fff}.card,.view{break-inside:avoid}}
"""

SCRIPT = """
const box=document.getElementById('zoom');
document.querySelectorAll('figure img').forEach(img=>{img.addEventListener('click',()=>{
box.firstElementChild.src=img.src;box.firstElementChild.alt=img.alt;box.showModal();});});
box.addEventListener('click',()=>box.close());
"""
