//! Robust losses: how much a squared residual counts.
//!
//! With `s = |r|^2` and the scale `a`, `rho(s)` is `s` for small residuals and grows more slowly beyond `a`:
//!
//!   trivial   s
//!   Huber     s for s <= a^2, else 2 a sqrt(s) - a^2
//!   soft L1   2 a^2 (sqrt(1 + s / a^2) - 1)
//!   Cauchy    a^2 ln(1 + s / a^2)
//!
//! The weight `rho'(s)` is what iteratively reweighted least squares multiplies the residual's normal equations by
//! (Holland, Welsch, "Robust regression using iteratively reweighted least-squares", 1977).

use serde::{Deserialize, Serialize};

/// A robust loss; `scale` is in the unit of the residual.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case", deny_unknown_fields)]
pub enum RobustLoss {
    /// Least squares.
    #[default]
    Trivial,
    /// Quadratic up to `scale`, linear beyond.
    Huber {
        /// Where it turns linear.
        scale: f64,
    },
    /// A smooth Huber.
    SoftL1 {
        /// Where it turns linear.
        scale: f64,
    },
    /// Logarithmic: far outliers lose nearly all their pull.
    Cauchy {
        /// Where the pull is largest.
        scale: f64,
    },
}

impl RobustLoss {
    /// The loss `rho(s)` and the weight `rho'(s)` of a squared residual `s`.
    #[inline(always)]
    pub fn evaluate(self, s: f64) -> (f64, f64) {
        match self {
            Self::Trivial => (s, 1.0),
            Self::Huber { scale } => {
                if s <= scale * scale {
                    (s, 1.0)
                } else {
                    let r = s.sqrt();
                    (2.0 * scale * r - scale * scale, scale / r)
                }
            }
            Self::SoftL1 { scale } => {
                let a_sq = scale * scale;
                let root = (1.0 + s / a_sq).sqrt();
                (2.0 * a_sq * (root - 1.0), 1.0 / root)
            }
            Self::Cauchy { scale } => {
                let a_sq = scale * scale;
                (a_sq * (s / a_sq).ln_1p(), 1.0 / (1.0 + s / a_sq))
            }
        }
    }

    /// Adds a sentence for a scale that is not a positive number; `name` is the option it belongs to.
    pub fn validate(self, name: &str, errors: &mut Vec<String>) {
        match self {
            Self::Trivial => {}
            Self::Huber { scale } | Self::SoftL1 { scale } | Self::Cauchy { scale } => {
                if !(scale.is_finite() && scale > 0.0) {
                    errors.push(format!("{name}: the scale must be positive, not {scale}"));
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const LOSSES: [RobustLoss; 4] = [
        RobustLoss::Trivial,
        RobustLoss::Huber { scale: 1.5 },
        RobustLoss::SoftL1 { scale: 1.5 },
        RobustLoss::Cauchy { scale: 1.5 },
    ];

    #[test]
    fn weights_are_derivatives() {
        for loss in LOSSES {
            for s in [0.01, 1.0, 2.0, 3.0, 50.0, 1e4] {
                let step = 1e-4 * s;
                let difference = (loss.evaluate(s + step).0 - loss.evaluate(s - step).0) / (2.0 * step);
                assert!((loss.evaluate(s).1 - difference).abs() < 1e-6, "{loss:?} at {s}");
            }
        }
    }

    #[test]
    fn small_residuals_count_fully_and_large_ones_less() {
        for loss in LOSSES {
            let (small, weight) = loss.evaluate(1e-8);
            assert!((small - 1e-8).abs() < 1e-15 && (weight - 1.0).abs() < 1e-7);
        }
        let at_large: Vec<f64> = LOSSES.iter().map(|loss| loss.evaluate(1e4).0).collect();
        assert!(at_large[0] > at_large[1] && at_large[1] > at_large[2] && at_large[2] > at_large[3]);
    }

    #[test]
    fn bad_scales_are_named() {
        let mut errors = Vec::new();
        RobustLoss::Cauchy { scale: 0.0 }.validate("loss", &mut errors);
        RobustLoss::Huber { scale: f64::NAN }.validate("loss", &mut errors);
        RobustLoss::SoftL1 { scale: 1.0 }.validate("loss", &mut errors);
        assert_eq!(errors.len(), 2);
    }
}
