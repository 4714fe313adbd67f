//! An HTML page of headings, paragraphs, tables, charts and pictures.
//!
//! Invariants: 1. the page fetches nothing: styles, scripts and pictures are inside the file; 2. this module escapes
//! every text, so callers pass plain text.

use crate::base::text::head_of;
use crate::base::units::format_bytes;
use std::path::Path;

const STYLE: &str = "\
:root{color-scheme:light dark;--ink:#1d2228;--dim:#5d6773;--line:#dfe3e8;--paper:#fff;--back:#f5f6f8;--accent:#2463b4;--grid:#e5e5e5}
@media(prefers-color-scheme:dark){:root{--ink:#e4e8ec;--dim:#a3adb8;--line:#39424c;--paper:#1c2127;--back:#12161a;--accent:#7fb2f0;--grid:#333b44}
figure svg.chart{filter:brightness(1.25)}}
*{box-sizing:border-box}
body{margin:0;background:var(--back);color:var(--ink);font:15px/1.5 system-ui,sans-serif}
main{max-width:1080px;margin:0 auto;padding:28px 20px 60px}
h1{font-size:26px;margin:0 0 4px}
h1,p{overflow-wrap:anywhere}
h2{font-size:18px;margin:36px 0 10px}
p.dim,figcaption{color:var(--dim)}
section.tiles{display:flex;flex-wrap:wrap;gap:12px;margin:18px 0}
.tile{background:var(--paper);border:1px solid var(--line);border-radius:8px;padding:10px 16px;min-width:130px}
.tile b{display:block;font-size:21px}
.tile span{color:var(--dim);font-size:13px}
.charts{display:grid;grid-template-columns:repeat(auto-fill,minmax(min(440px,100%),1fr));gap:14px}
figure{margin:0;background:var(--paper);border:1px solid var(--line);border-radius:8px;padding:10px}
figure.wide{margin-bottom:14px}
figure svg{width:100%;height:auto;display:block}
figure svg text{fill:var(--ink)}
figure svg [fill=\"#FFFFFF\"]{fill:var(--paper)}
figure svg [stroke=\"#616161\"]{stroke:var(--dim)}
figure svg [stroke=\"#E0E0E0\"]{stroke:var(--grid)}
figcaption{font-size:14px;margin-top:6px}
figcaption b{color:var(--ink);font-variant-numeric:tabular-nums}
table{border-collapse:collapse;background:var(--paper);border:1px solid var(--line);font-size:14px}
td,th{padding:4px 9px;border-bottom:1px solid var(--line);text-align:left}
td.number{white-space:nowrap;text-align:right;font-variant-numeric:tabular-nums}
pre{background:var(--paper);border:1px solid var(--line);border-radius:8px;padding:12px;overflow:auto;font-size:13px;max-height:420px}
div.table{overflow-x:auto}
th{vertical-align:bottom}
.views{display:grid;grid-template-columns:repeat(auto-fill,minmax(min(440px,100%),1fr));gap:14px}
figure{position:relative}
figure .pointed{position:absolute;pointer-events:none;background:var(--paper);border:1px solid var(--line);border-radius:6px;padding:3px 8px;font-size:13px;white-space:pre;font-variant-numeric:tabular-nums;box-shadow:0 1px 4px #0004}
figure svg.chart{touch-action:pan-y;cursor:crosshair}
.slider{position:relative;overflow:hidden;line-height:0;touch-action:pan-y;cursor:ew-resize}
.slider img{width:100%;display:block}
.slider .over{position:absolute;inset:0;width:50%;overflow:hidden;border-right:2px solid #fff}
.slider .over img{width:auto;height:100%;max-width:none}
@media(max-width:520px){main{padding:18px 10px 40px}.tile{min-width:0;flex:1 1 40%}}
.slider i{position:absolute;top:6px;font:12px system-ui;color:#fff;background:#0009;padding:3px 7px;border-radius:4px;line-height:1.2}
.slider i.l{left:6px}.slider i.r{right:6px}
details summary{cursor:pointer;color:var(--accent)}
";

/// Moves the edge between the two pictures of a slider with the pointer or the arrow keys; shows the values of a chart under the pointer.
const SCRIPT: &str = "\
document.querySelectorAll('.slider').forEach(function(s){var o=s.querySelector('.over');
function fit(){o.querySelector('img').style.width=s.clientWidth+'px';}
function to(f){f=Math.max(0,Math.min(1,f));o.style.width=(f*100)+'%';s.setAttribute('aria-valuenow',Math.round(f*100));}
['pointermove','pointerdown'].forEach(function(n){s.addEventListener(n,function(e){var r=s.getBoundingClientRect();to((e.clientX-r.left)/r.width);});});
s.addEventListener('keydown',function(e){var f=+s.getAttribute('aria-valuenow')/100;
if(e.key==='ArrowLeft')to(f-.05);if(e.key==='ArrowRight')to(f+.05);});
window.addEventListener('resize',fit);fit();to(.5);});
document.querySelectorAll('svg[data-plot]').forEach(function(s){var d=JSON.parse(s.dataset.plot),figure=s.closest('figure');
var all=d.series.filter(function(a){return a.points.length});if(!all.length||!figure)return;
var tip=document.createElement('div');tip.className='pointed';tip.hidden=true;figure.append(tip);
s.insertAdjacentHTML('beforeend','<line stroke=\"currentColor\" visibility=\"hidden\" opacity=\".5\" y1=\"'+d.plot[1]+'\" y2=\"'+d.plot[3]+'\"/>');
var line=s.lastElementChild;
function text(v){return v.toLocaleString('en',{maximumFractionDigits:Math.abs(v)<10?4:Math.abs(v)<1000?2:0});}
function show(e){var r=s.getBoundingClientRect(),scale=s.viewBox.baseVal.width/r.width,wide=(d.plot[2]-d.plot[0])/(d.x[1]-d.x[0]);
var at=d.x[0]+((e.clientX-r.left)*scale-d.plot[0])/wide;
function nearest(points){return points.reduce(function(a,b){return Math.abs(b[0]-at)<Math.abs(a[0]-at)?b:a});}
var found=all.map(function(a){return[a.name,nearest(a.points)]}),x=nearest(found.map(function(f){return f[1]}))[0];
tip.textContent=d.of+' '+text(x)+found.map(function(f){return'\\n'+(f[0]?f[0]+': ':'')+text(f[1][1])+(f[1][0]===x?'':' ('+d.of+' '+text(f[1][0])+')')}).join('');
var px=d.plot[0]+(x-d.x[0])*wide;line.setAttribute('x1',px);line.setAttribute('x2',px);line.setAttribute('visibility','visible');tip.hidden=false;
var left=s.offsetLeft||r.left-figure.getBoundingClientRect().left,place=left+px/scale,half=place>figure.clientWidth/2;
tip.style.top='34px';tip.style.left=half?'auto':place+8+'px';tip.style.right=half?figure.clientWidth-place+8+'px':'auto';}
s.addEventListener('pointermove',show);s.addEventListener('pointerdown',show);
s.addEventListener('pointerleave',function(){tip.hidden=true;line.setAttribute('visibility','hidden');});});
";

pub struct Page {
    title: String,
    body: String,
}

#[derive(Debug, Clone)]
pub enum Cell {
    Text(String),
    /// Right-aligned number, already formatted.
    Number(String),
}

impl Cell {
    pub fn text(text: impl Into<String>) -> Cell {
        Cell::Text(text.into())
    }

    /// A number; an empty cell for `None`.
    pub fn number(value: Option<f64>, digits: usize) -> Cell {
        Cell::Number(value.map_or(String::new(), |v| format!("{v:.digits$}")))
    }

    /// A number with its sign; an empty cell for `None`.
    pub fn difference(value: Option<f64>, digits: usize) -> Cell {
        Cell::Number(value.map_or(String::new(), |v| format!("{v:+.digits$}")))
    }

    /// A number of bytes; a dash for 0 and `None`.
    pub fn bytes(value: Option<f64>) -> Cell {
        Cell::Number(value.filter(|b| *b > 0.0).map_or("–".to_string(), |b| format_bytes(b as u64)))
    }
}

impl Page {
    pub fn new(title: &str, subtitle: &str) -> Page {
        let body = format!("<h1>{}</h1>\n<p class=\"dim\">{}</p>\n", escape(title), escape(subtitle));
        Page { title: title.to_string(), body }
    }

    pub fn heading(&mut self, text: &str) {
        self.body += &format!("<h2>{}</h2>\n", escape(text));
    }

    pub fn paragraph(&mut self, text: &str) {
        self.body += &format!("<p>{}</p>\n", escape(text));
    }

    /// Key figures side by side: (value, label).
    pub fn tiles(&mut self, tiles: &[(String, &str)]) {
        self.body += "<section class=\"tiles\">\n";
        for (value, label) in tiles {
            let (value, label) = (escape(value), escape(label));
            self.body += &format!("<div class=\"tile\"><b>{value}</b><span>{label}</span></div>\n");
        }
        self.body += "</section>\n";
    }

    /// Charts in a grid: (SVG, caption). The texts of the SVG, and of markup below it, are escaped.
    pub fn charts(&mut self, charts: &[(String, String)]) {
        self.body += "<div class=\"charts\">\n";
        charts.iter().for_each(|(svg, caption)| self.figure("", svg, caption));
        self.body += "</div>\n";
    }

    /// A chart over the whole width.
    pub fn wide_chart(&mut self, svg: &str, caption: &str) {
        self.figure("wide", svg, caption);
    }

    fn figure(&mut self, class: &str, svg: &str, caption: &str) {
        let caption = escape(caption);
        self.body += &format!("<figure class=\"{class}\">{svg}<figcaption>{caption}</figcaption></figure>\n");
    }

    pub fn table<'a>(&mut self, head: impl IntoIterator<Item = &'a str>, rows: impl IntoIterator<Item = Vec<Cell>>) {
        let head: String = head.into_iter().map(|heading| format!("<th>{}</th>", escape(heading))).collect();
        self.body += &format!("<div class=\"table\"><table><thead><tr>{head}</tr></thead><tbody>\n");
        for row in rows {
            let cells = row.iter().map(|cell| match cell {
                Cell::Text(text) => format!("<td>{}</td>", escape(text)),
                Cell::Number(text) => format!("<td class=\"number\">{}</td>", escape(text)),
            });
            self.body += &format!("<tr>{}</tr>\n", cells.collect::<String>());
        }
        self.body += "</tbody></table></div>\n";
    }

    pub fn views(&mut self, sliders: &[String]) {
        self.body += &format!("<div class=\"views\">\n{}</div>\n", sliders.concat());
    }

    pub fn folded(&mut self, summary: &str, text: &str) {
        let (summary, text) = (escape(summary), escape(text));
        self.body += &format!("<details><summary>{summary}</summary><pre>{text}</pre></details>\n");
    }

    pub fn finish(self) -> String {
        format!(
            "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\">\
             <meta name=\"viewport\" content=\"width=device-width,initial-scale=1\"><title>{}</title>\n\
             <style>{STYLE}</style></head>\n<body><main>\n{}</main>\n<script>{SCRIPT}</script></body></html>\n",
            escape(&self.title),
            self.body
        )
    }
}

/// Whether a file is an HTML page, as [`Page::finish`] makes one.
pub fn is_page(file: &Path) -> bool {
    head_of(file, 64).trim_start().to_ascii_lowercase().starts_with("<!doctype html>")
}

/// HTML of two pictures of a view, one over the other with a movable edge, a caption with the name and `figures` of the
/// view, and a third picture behind a fold. A picture is (label, data URI).
pub fn slider(name: &str, figures: &str, [left, right]: [(&str, &str); 2], folded: (&str, &str)) -> String {
    let (name, figures) = (escape(name), escape(figures));
    let [(left, left_uri), (right, right_uri), (fold, fold_uri)] =
        [left, right, folded].map(|(label, uri)| (escape(label), uri));
    format!(
        "<figure><div class=\"slider\" tabindex=\"0\" role=\"slider\" aria-label=\"{left} against {right} of {name}\" \
         aria-valuenow=\"50\"><img src=\"{right_uri}\" alt=\"{right}\"><div class=\"over\"><img src=\"{left_uri}\" \
         alt=\"{left}\"></div><i class=\"l\">{left}</i><i class=\"r\">{right}</i></div>\n<figcaption>{name} <b>{figures}</b> \
         <details><summary>{fold}</summary><img src=\"{fold_uri}\" alt=\"{fold}\" style=\"width:100%\"></details>\
         </figcaption></figure>\n"
    )
}

pub fn escape(text: &str) -> String {
    let text = text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;");
    text.replace('"', "&quot;").replace('\'', "&#39;")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hostile_text_stays_text() {
        let hostile = "<script>alert('x')</script>\" onload=\"y";
        let mut page = Page::new(hostile, hostile);
        page.heading(hostile);
        page.table([hostile], [vec![Cell::text(hostile), Cell::Number(hostile.into())]]);
        page.folded(hostile, hostile);
        page.tiles(&[(hostile.into(), hostile)]);
        page.views(&[slider(hostile, hostile, [(hostile, "data:,"); 2], (hostile, "data:,"))]);
        let text = page.finish();
        assert_eq!(text.matches("<script>").count(), 1, "only the page's own");
        assert!(!text.contains("\" onload"));
        assert!(text.contains("&lt;script&gt;"));
    }
}
