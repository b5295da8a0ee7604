//! `report.html`: the account of a run for people. One file without scripts or outside references: it works offline and
//! can be mailed. Every text that comes from outside is escaped.

mod page;
mod plot;

use std::collections::BTreeMap;
use std::fmt::{self, Display};
use std::io::{self, Write};

use super::report::{ImageReport, ImageState, ModelReport, Report};
use crate::scene::Reconstruction;

/// Writes the page. `models` are those of `report.models`, in the same order; `thumbnails` are small JPEGs by image name, as
/// many as there are.
///
/// # Errors
/// When writing fails.
pub fn write(
    report: &Report,
    models: &[&Reconstruction],
    thumbnails: &BTreeMap<String, Vec<u8>>,
    out: &mut impl Write,
) -> io::Result<()> {
    write!(
        out,
        "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\">\
         <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\
         <title>Reconstruction report</title><style>{}</style></head>\n<body><main>\n",
        include_str!("style.css")
    )?;
    page::head(report, out)?;
    page::notes(report, out)?;
    for (account, model) in report.models.iter().zip(models) {
        page::model(report, account, model, out)?;
    }
    page::images_left_out(report, thumbnails, out)?;
    page::stages(report, out)?;
    page::images_placed(report, thumbnails, out)?;
    page::settings(report, out)?;
    out.write_all(b"</main></body></html>\n")
}

/// Text with the characters that mean something in HTML replaced.
struct Escaped<'a>(&'a str);

impl Display for Escaped<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.chars().try_for_each(|c| match c {
            '&' => f.write_str("&amp;"),
            '<' => f.write_str("&lt;"),
            '>' => f.write_str("&gt;"),
            '"' => f.write_str("&quot;"),
            '\'' => f.write_str("&#39;"),
            c => write!(f, "{c}"),
        })
    }
}

/// A whole number with its thousands apart.
struct Grouped(usize);

impl Display for Grouped {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let digits = self.0.to_string();
        for (at, digit) in digits.chars().enumerate() {
            if at > 0 && (digits.len() - at).is_multiple_of(3) {
                f.write_str("\u{202f}")?;
            }
            write!(f, "{digit}")?;
        }
        Ok(())
    }
}

/// A duration as people say it.
struct Duration(f64);

impl Display for Duration {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let seconds = self.0.max(0.0);
        if seconds < 9.95 {
            return write!(f, "{seconds:.1} s");
        }
        let whole = seconds.round() as u64;
        match (whole / 3600, whole / 60 % 60, whole % 60) {
            (0, 0, s) => write!(f, "{s} s"),
            (0, m, s) => write!(f, "{m} min {s:02} s"),
            (h, m, _) => write!(f, "{h} h {m:02} min"),
        }
    }
}

/// A length in pixels, or a dash where it is unknown.
struct Pixels(Option<f64>);

impl Display for Pixels {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.0 {
            Some(length) => write!(f, "{length:.2} px"),
            None => f.write_str("\u{2013}"),
        }
    }
}

/// Bytes in base 64 (RFC 4648), for data URIs.
struct Base64<'a>(&'a [u8]);

impl Display for Base64<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        const DIGITS: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
        for chunk in self.0.chunks(3) {
            let byte = |at: usize| u32::from(chunk.get(at).copied().unwrap_or(0));
            let bits = byte(0) << 16 | byte(1) << 8 | byte(2);
            for at in 0..4 {
                let digit = if at <= chunk.len() { DIGITS[(bits >> (18 - 6 * at) & 63) as usize] } else { b'=' };
                write!(f, "{}", char::from(digit))?;
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn texts_and_numbers() {
        assert_eq!(
            Escaped("<a href=\"x\">'&'</a>").to_string(),
            "&lt;a href=&quot;x&quot;&gt;&#39;&amp;&#39;&lt;/a&gt;"
        );
        assert_eq!(
            [0, 999, 1000, 1_234_567].map(|n| Grouped(n).to_string().replace('\u{202f}', " ")),
            ["0", "999", "1 000", "1 234 567"]
        );
        let durations = [0.04, 9.96, 59.4, 61.0, 3725.0].map(|s| Duration(s).to_string());
        assert_eq!(durations, ["0.0 s", "10 s", "59 s", "1 min 01 s", "1 h 02 min"]);
        let encoded = [&b""[..], b"f", b"fo", b"foo", b"foob", b"\xff\xff\xfe"].map(|bytes| Base64(bytes).to_string());
        assert_eq!(encoded, ["", "Zg==", "Zm8=", "Zm9v", "Zm9vYg==", "///+"]);
    }
}
