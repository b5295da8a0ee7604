//! Numbers as text.

use std::fmt::{self, Display, Formatter};

/// A number with as many digits as it takes to read the same one back. Its own `Display`, which prints no exponents, took
/// more than half of the time of writing a model.
pub(super) struct Shortest(pub(super) f64);

impl Display for Shortest {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        f.write_str(zmij::Buffer::new().format(self.0))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_same_number_is_read_back() {
        for value in [0.0, -0.0, 1.0, -12.5, 0.1, 1.0 / 3.0, 1234.5, 1e-7, -6.022e23, f64::MAX, f64::MIN_POSITIVE] {
            let read: f64 = Shortest(value).to_string().parse().unwrap();
            assert_eq!(read.to_bits(), value.to_bits(), "{}", Shortest(value));
        }
        assert_eq!(format!("{} {}", Shortest(0.1), Shortest(2500.0)), "0.1 2500.0");
    }
}
