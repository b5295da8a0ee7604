//! Names of photographs as senders give them, made safe.
//!
//! A name is kept as it came, in any script and with its sub-folders, and refused when it could mean something else than a file
//! below the dataset's folder, or could not be written into the line-based model formats.

use std::fmt;

/// Bytes a file system takes for one part of a path.
const MAX_PART_BYTES: usize = 255;
/// Bytes of a whole name; far below every system's limit, with the data directory in front.
const MAX_NAME_BYTES: usize = 1024;
/// Folders above a file.
const MAX_FOLDERS: usize = 32;
/// Extensions of photographs, in lower case.
const PHOTOGRAPH_EXTENSIONS: [&str; 6] = ["jpg", "jpeg", "png", "tif", "tiff", "webp"];

/// The path of a photograph within its dataset: relative, with `/`, without `.` and `..`.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct ImagePath(String);

/// Why a name was refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum InvalidFileName {
    /// Nothing is left of it.
    #[error("the file name is empty")]
    Empty,
    /// It starts at the root or with a drive letter.
    #[error("the file name is an absolute path")]
    Absolute,
    /// It climbs with `..`.
    #[error("the file name leaves its folder")]
    Traversal,
    /// It holds a backslash, which some systems take for a separator.
    #[error("the file name holds a backslash")]
    Backslash,
    /// It holds a control character, such as NUL or a line break.
    #[error("the file name holds a control character")]
    Control,
    /// It is not UTF-8.
    #[error("the file name is not UTF-8")]
    Encoding,
    /// It is too long or too deep.
    #[error("the file name is too long")]
    TooLong,
}

impl ImagePath {
    /// Takes a name as sent. Parts that are empty or `.` are dropped.
    ///
    /// # Errors
    /// Why it was refused.
    pub fn parse(name: &str) -> Result<Self, InvalidFileName> {
        if name.chars().any(char::is_control) {
            return Err(InvalidFileName::Control);
        }
        if name.contains('\\') {
            return Err(InvalidFileName::Backslash);
        }
        if name.starts_with('/') {
            return Err(InvalidFileName::Absolute);
        }
        let parts: Vec<&str> = name.split('/').filter(|part| !part.is_empty() && *part != ".").collect();
        if parts.contains(&"..") {
            return Err(InvalidFileName::Traversal);
        }
        if parts.iter().any(|part| part.len() > MAX_PART_BYTES) || parts.len() > MAX_FOLDERS + 1 {
            return Err(InvalidFileName::TooLong);
        }
        let path = parts.join("/");
        // Once the dots are gone: `./c:a.jpg` names a drive, too.
        let mut letters = path.chars();
        if letters.next().is_some_and(|c| c.is_ascii_alphabetic()) && letters.next() == Some(':') {
            return Err(InvalidFileName::Absolute);
        }
        match path.len() {
            0 => Err(InvalidFileName::Empty),
            1..=MAX_NAME_BYTES => Ok(Self(path)),
            _ => Err(InvalidFileName::TooLong),
        }
    }

    /// The path.
    pub fn as_str(&self) -> &str {
        &self.0
    }

    /// Whether its extension is a photograph's, and it is not one of the companion files that systems add to folders.
    pub fn is_photograph(&self) -> bool {
        let hidden = self.0.split('/').any(|part| part.starts_with('.') || part == "__MACOSX");
        let extension = self.0.rsplit_once('.').map(|(_, extension)| extension.to_ascii_lowercase());
        !hidden && extension.is_some_and(|extension| PHOTOGRAPH_EXTENSIONS.contains(&extension.as_str()))
    }
}

impl fmt::Display for ImagePath {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn names_are_kept_as_they_came() {
        for name in
            ["a.jpg", "north face/IMG 1.JPG", "神社/石段 (1).jpeg", "a'b\"c;d%2e.png", "été/..x.tif", "a..b/c..jpg"]
        {
            assert_eq!(ImagePath::parse(name).unwrap().as_str(), name);
        }
        assert_eq!(ImagePath::parse("./a//b/./c.jpg").unwrap().as_str(), "a/b/c.jpg");
    }

    #[test]
    fn names_that_mean_something_else_are_refused() {
        use InvalidFileName::*;
        let long = "x".repeat(256);
        let deep = "d/".repeat(33) + "x";
        for (name, why) in [
            ("", Empty),
            ("./", Empty),
            ("..", Traversal),
            ("../a.jpg", Traversal),
            ("a/../../b.jpg", Traversal),
            ("/etc/passwd", Absolute),
            ("C:/a.jpg", Absolute),
            ("c:a.jpg", Absolute),
            (".//c:a.jpg", Absolute),
            ("a\\..\\b.jpg", Backslash),
            ("a\0.jpg", Control),
            ("a\n.jpg", Control),
            (&long, TooLong),
            (&deep, TooLong),
        ] {
            assert_eq!(ImagePath::parse(name), Err(why), "{name:?}");
        }
    }

    #[test]
    fn photographs_are_known_by_their_extension() {
        for (name, is) in [
            ("a.jpg", true),
            ("a/B.TIFF", true),
            ("a.webp", true),
            ("a.txt", false),
            ("jpg", false),
            ("._a.jpg", false),
            ("__MACOSX/a.jpg", false),
            (".git/a.png", false),
        ] {
            assert_eq!(ImagePath::parse(name).unwrap().is_photograph(), is, "{name}");
        }
    }

    proptest! {
        #[test]
        fn what_is_accepted_stays_below_its_folder(name in "\\PC{0,40}|[./a\\\\:]{0,20}") {
            if let Ok(path) = ImagePath::parse(&name) {
                let plain = std::path::Path::new(path.as_str())
                    .components()
                    .all(|part| matches!(part, std::path::Component::Normal(_)));
                prop_assert!(plain);
                prop_assert_eq!(ImagePath::parse(path.as_str()).unwrap(), path);
            }
        }
    }
}
