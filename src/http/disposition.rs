//! File names out of the heads of a form's parts, as every client writes them.

use axum::http::{HeaderMap, header};

use super::problem::{Code, Problem};
use crate::store::InvalidFileName;

/// The file name of a part, with its folders: `filename*` (RFC 8187) when there is one, else `filename`, where a
/// backslash stands before a quote or another backslash only.
pub(super) fn file_name(headers: &HeaderMap) -> Result<String, Problem> {
    let missing = || Problem::new(Code::InvalidMultipart).detail("a part `images` has no file name");
    let value = headers.get(header::CONTENT_DISPOSITION).ok_or_else(missing)?;
    let text = std::str::from_utf8(value.as_bytes())
        .map_err(|_| Problem::file_name(&String::from_utf8_lossy(value.as_bytes()), InvalidFileName::Encoding))?;
    let mut plain = None;
    for (key, value) in parameters(text) {
        match key.as_str() {
            "filename*" => {
                let encoded = value.splitn(3, '\'').nth(2).ok_or_else(missing)?.to_owned();
                return percent_encoding::percent_decode_str(&encoded)
                    .decode_utf8()
                    .map(std::borrow::Cow::into_owned)
                    .map_err(|_| Problem::file_name(&encoded, InvalidFileName::Encoding));
            }
            "filename" => plain = Some(value),
            _ => {}
        }
    }
    plain.ok_or_else(missing)
}

/// The parameters of a header value such as `form-data; name="a"; filename="b;c"`, keys in lower case.
fn parameters(value: &str) -> Vec<(String, String)> {
    let mut found = Vec::new();
    let mut rest = value.find(';').map_or("", |at| &value[at + 1..]);
    while let Some((key, after)) = rest.split_once('=') {
        let key = key.trim_start_matches([';', ' ', '\t']).trim_end().to_ascii_lowercase();
        let after = after.trim_start();
        let (text, end) = match after.strip_prefix('"') {
            Some(quoted) => {
                let (text, end) = unquote(quoted);
                (text, end + 1)
            }
            None => {
                let end = after.find(';').unwrap_or(after.len());
                (after[..end].trim_end().to_owned(), end)
            }
        };
        found.push((key, text));
        rest = &after[end..];
    }
    found
}

/// The text up to the closing quote, and where that ends.
fn unquote(quoted: &str) -> (String, usize) {
    let mut text = String::new();
    let mut letters = quoted.char_indices().peekable();
    while let Some((at, letter)) = letters.next() {
        match letter {
            '"' => return (text, at + 1),
            '\\' if matches!(letters.peek(), Some((_, '"' | '\\'))) => text.extend(letters.next().map(|(_, c)| c)),
            other => text.push(other),
        }
    }
    (text, quoted.len())
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    fn name_of(disposition: &str) -> Option<String> {
        let mut headers = HeaderMap::new();
        let value = header::HeaderValue::from_bytes(disposition.as_bytes()).unwrap();
        headers.insert(header::CONTENT_DISPOSITION, value);
        file_name(&headers).ok()
    }

    #[test]
    fn file_names_come_as_every_client_writes_them() {
        for (disposition, name) in [
            (r#"form-data; name="images"; filename="a/b c.jpg""#, "a/b c.jpg"),
            (r#"form-data; name=images; filename=a.jpg"#, "a.jpg"),
            (r#"form-data; filename="x;y=\"z\".jpg"; name="images""#, r#"x;y="z".jpg"#),
            (r#"form-data; name="images"; filename="石段.jpg""#, "石段.jpg"),
            (r#"form-data; name="images"; filename="x.jpg"; filename*=utf-8''%E7%9F%B3%20a.jpg"#, "石 a.jpg"),
            (r#"form-data; name="filename=evil"; filename="real.jpg""#, "real.jpg"),
            (r#"form-data; name="images"; FileName="a\b.jpg""#, r"a\b.jpg"),
        ] {
            assert_eq!(name_of(disposition).as_deref(), Some(name), "{disposition}");
        }
        assert_eq!(name_of(r#"form-data; name="images""#), None);
        assert_eq!(name_of(r#"form-data; filename*=broken"#), None);
    }
}
