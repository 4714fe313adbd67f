//! A page: headings, paragraphs, tables, charts, pictures, put together as one HTML text.
//!
//! Invariants: 1. nothing is fetched: styles, scripts and pictures are inside the file; 2. every text from outside is
//! escaped here, so callers pass plain text.

use std::fmt::Write as _;

const STYLE: &str = "\
:root{--ink:#1d2228;--dim:#66707c;--line:#dfe3e8;--paper:#fff;--back:#f5f6f8;--accent:#2463b4}
*{box-sizing:border-box}
body{margin:0;background:var(--back);color:var(--ink);font:15px/1.5 system-ui,sans-serif}
main{max-width:1080px;margin:0 auto;padding:28px 20px 60px}
h1{font-size:26px;margin:0 0 4px}
h2{font-size:18px;margin:36px 0 10px}
p.dim,figcaption,td.dim{color:var(--dim)}
section.tiles{display:flex;flex-wrap:wrap;gap:12px;margin:18px 0}
.tile{background:var(--paper);border:1px solid var(--line);border-radius:8px;padding:10px 16px;min-width:130px}
.tile b{display:block;font-size:21px}
.tile span{color:var(--dim);font-size:13px}
.charts{display:grid;grid-template-columns:repeat(auto-fill,minmax(440px,1fr));gap:14px}
figure{margin:0;background:var(--paper);border:1px solid var(--line);border-radius:8px;padding:10px}
figure.wide{margin-bottom:14px}
figure svg{width:100%;height:auto;display:block}
figcaption{font-size:13px;margin-top:6px}
table{border-collapse:collapse;background:var(--paper);border:1px solid var(--line);font-size:14px}
td,th{padding:4px 9px;border-bottom:1px solid var(--line);text-align:left}
td.number{white-space:nowrap;text-align:right;font-variant-numeric:tabular-nums}
pre{background:var(--paper);border:1px solid var(--line);border-radius:8px;padding:12px;overflow:auto;font-size:13px;max-height:420px}
div.table{overflow-x:auto}
th{vertical-align:bottom}
.views{display:grid;grid-template-columns:repeat(auto-fill,minmax(440px,1fr));gap:14px}
.slider{position:relative;overflow:hidden;line-height:0;touch-action:none;cursor:ew-resize}
.slider img{width:100%;display:block}
.slider .over{position:absolute;inset:0;width:50%;overflow:hidden;border-right:2px solid #fff}
.slider .over img{width:auto;height:100%;max-width:none}
.slider i{position:absolute;top:6px;font:12px system-ui;color:#fff;background:#0009;padding:3px 7px;border-radius:4px;line-height:1.2}
.slider i.l{left:6px}.slider i.r{right:6px}
details summary{cursor:pointer;color:var(--accent)}
";

/// Moves the edge between the two pictures of a slider; arrow keys work too.
const SCRIPT: &str = "\
document.querySelectorAll('.slider').forEach(function(s){var o=s.querySelector('.over');
function fit(){o.querySelector('img').style.width=s.clientWidth+'px';}
function to(f){f=Math.max(0,Math.min(1,f));o.style.width=(f*100)+'%';s.setAttribute('aria-valuenow',Math.round(f*100));}
s.addEventListener('pointermove',function(e){var r=s.getBoundingClientRect();to((e.clientX-r.left)/r.width);});
s.addEventListener('keydown',function(e){var f=+s.getAttribute('aria-valuenow')/100;
if(e.key==='ArrowLeft')to(f-.05);if(e.key==='ArrowRight')to(f+.05);});
window.addEventListener('resize',fit);fit();to(.5);});
";

/// A page in the making.
pub struct Page {
    title: String,
    body: String,
}

/// A cell of a table.
#[derive(Debug, Clone)]
pub enum Cell {
    /// Left-aligned text.
    Text(String),
    /// Right-aligned number, already formatted.
    Number(String),
}

impl Page {
    /// A page with a title and a line under it.
    pub fn new(title: &str, subtitle: &str) -> Page {
        let mut page = Page { title: title.to_string(), body: String::new() };
        page.push(format_args!("<h1>{}</h1>\n<p class=\"dim\">{}</p>\n", escape(title), escape(subtitle)));
        page
    }

    fn push(&mut self, text: std::fmt::Arguments) {
        // Writing to a String cannot fail.
        let _ = self.body.write_fmt(text);
    }

    /// A heading.
    pub fn heading(&mut self, text: &str) {
        self.push(format_args!("<h2>{}</h2>\n", escape(text)));
    }

    /// A paragraph.
    pub fn paragraph(&mut self, text: &str) {
        self.push(format_args!("<p>{}</p>\n", escape(text)));
    }

    /// Key figures side by side: (value, what it is).
    pub fn tiles(&mut self, tiles: &[(String, &str)]) {
        self.push(format_args!("<section class=\"tiles\">\n"));
        for (value, label) in tiles {
            let (value, label) = (escape(value), escape(label));
            self.push(format_args!("<div class=\"tile\"><b>{value}</b><span>{label}</span></div>\n"));
        }
        self.push(format_args!("</section>\n"));
    }

    /// Charts in a grid: SVG made by [`super::chart`], which escapes its own texts, and a caption.
    pub fn charts(&mut self, charts: &[(String, String)]) {
        self.push(format_args!("<div class=\"charts\">\n"));
        for (svg, caption) in charts {
            self.push(format_args!("<figure>{svg}<figcaption>{}</figcaption></figure>\n", escape(caption)));
        }
        self.push(format_args!("</div>\n"));
    }

    /// A chart over the whole width.
    pub fn wide_chart(&mut self, svg: &str, caption: &str) {
        self.push(format_args!("<figure class=\"wide\">{svg}<figcaption>{}</figcaption></figure>\n", escape(caption)));
    }

    /// A table.
    pub fn table(&mut self, head: &[&str], rows: &[Vec<Cell>]) {
        self.push(format_args!("<div class=\"table\"><table><thead><tr>"));
        for name in head {
            self.push(format_args!("<th>{}</th>", escape(name)));
        }
        self.push(format_args!("</tr></thead><tbody>\n"));
        for row in rows {
            self.push(format_args!("<tr>"));
            for cell in row {
                match cell {
                    Cell::Text(text) => self.push(format_args!("<td>{}</td>", escape(text))),
                    Cell::Number(text) => self.push(format_args!("<td class=\"number\">{}</td>", escape(text))),
                }
            }
            self.push(format_args!("</tr>\n"));
        }
        self.push(format_args!("</tbody></table></div>\n"));
    }

    /// Opens a grid of views; close it with [`Page::end_views`].
    pub fn begin_views(&mut self) {
        self.push(format_args!("<div class=\"views\">\n"));
    }

    /// Ends the grid of views.
    pub fn end_views(&mut self) {
        self.push(format_args!("</div>\n"));
    }

    /// A render over its photo with a movable edge, and the map of differences behind a fold. Pictures as data URIs.
    pub fn view(&mut self, name: &str, render: &str, photo: &str, difference: &str, caption: &str) {
        self.slider(name, [("render", render), ("photo", photo)], ("difference", difference), caption);
    }

    /// Two pictures of the same view, (what it is, data URI), one over the other with a movable edge, and a third one
    /// behind a fold.
    pub fn slider(&mut self, name: &str, [left, right]: [(&str, &str); 2], folded: (&str, &str), caption: &str) {
        let (name, caption) = (escape(name), escape(caption));
        let [(left, left_uri), (right, right_uri), (fold, fold_uri)] =
            [left, right, folded].map(|(what, uri)| (escape(what), uri));
        self.push(format_args!(
            "<figure><div class=\"slider\" tabindex=\"0\" role=\"slider\" aria-label=\"{left} against {right} of {name}\" \
             aria-valuenow=\"50\"><img src=\"{right_uri}\" alt=\"{right}\"><div class=\"over\"><img src=\"{left_uri}\" \
             alt=\"{left}\"></div><i class=\"l\">{left}</i><i class=\"r\">{right}</i></div>\n<figcaption>{name} {caption}\
             <details><summary>{fold}</summary><img src=\"{fold_uri}\" alt=\"{fold}\" style=\"width:100%\"></details>\
             </figcaption></figure>\n"
        ));
    }

    /// Text as it is, behind a fold.
    pub fn folded(&mut self, summary: &str, text: &str) {
        self.push(format_args!(
            "<details><summary>{}</summary><pre>{}</pre></details>\n",
            escape(summary),
            escape(text)
        ));
    }

    /// The whole file.
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

/// Text as HTML shows it literally.
pub fn escape(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '&' => out.push_str("&amp;"),
            '<' => out.push_str("&lt;"),
            '>' => out.push_str("&gt;"),
            '"' => out.push_str("&quot;"),
            '\'' => out.push_str("&#39;"),
            c => out.push(c),
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_comes_from_outside_stays_text() {
        let hostile = "<script>alert('x')</script>\" onload=\"y";
        let mut page = Page::new(hostile, hostile);
        page.heading(hostile);
        page.table(&[hostile], &[vec![Cell::Text(hostile.into()), Cell::Number(hostile.into())]]);
        page.folded(hostile, hostile);
        page.tiles(&[(hostile.into(), hostile)]);
        page.view(hostile, "data:,", "data:,", "data:,", hostile);
        let text = page.finish();
        assert_eq!(text.matches("<script>").count(), 1, "only the page's own");
        assert!(!text.contains("\" onload"));
        assert!(text.contains("&lt;script&gt;"));
    }
}
