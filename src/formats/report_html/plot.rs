//! Cameras and points of a model as SVG, seen from above or from the side. Models stand level with z up.

use std::collections::BTreeMap;
use std::io::{self, Write};

use nalgebra::{Vector2, Vector3};

use super::{Escaped, ImageReport, Reconstruction};
use crate::camera::{Camera, Pixel};
use crate::scene::RegisteredImage;

/// Where a plot looks from.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum View {
    /// From above, y up on the page.
    Top,
    /// From the side of negative y, z up on the page.
    Side,
}

impl View {
    /// A place in the world on the page, y up.
    fn flatten(self, x_in_world: &Vector3<f64>) -> Vector2<f64> {
        match self {
            Self::Top => x_in_world.xy(),
            Self::Side => Vector2::new(x_in_world.x, x_in_world.z),
        }
    }
}

/// Width of a plot in SVG units.
const WIDTH: f64 = 640.0;
/// Least and largest height over width, so that both plots fit a screen.
const ASPECT: (f64, f64) = (0.4, 1.1);
/// Empty border as a part of the extent.
const MARGIN: f64 = 0.06;
/// Points drawn at most; of more, evenly spaced ones.
const MAX_POINTS: usize = 12_000;
/// Share of the points on either side that may fall outside: stray points must not shrink the rest.
const STRAY_SHARE: f64 = 0.02;
/// Length of a camera's wedge in SVG units.
const WEDGE: f64 = 16.0;
/// Diameter of a dot in SVG units: of few points, and of as many as are drawn at most.
const DOT: (f64, f64) = (2.6, 1.5);

/// World to page.
struct Frame {
    view: View,
    low: Vector2<f64>,
    units_per_world: f64,
    height: f64,
}

impl Frame {
    fn around(model: &Reconstruction, view: View) -> Self {
        let points: Vec<Vector2<f64>> = model.points().map(|(_, point)| view.flatten(&point.xyz)).collect();
        let cameras: Vec<Vector2<f64>> =
            model.images().values().map(|image| view.flatten(&image.center_in_world())).collect();
        let (low_x, high_x) = extent(&points, &cameras, |at| at.x);
        let (low_y, high_y) = extent(&points, &cameras, |at| at.y);
        let border = MARGIN * (high_x - low_x).max(high_y - low_y).max(f64::MIN_POSITIVE);
        let size = Vector2::new(high_x - low_x, high_y - low_y).add_scalar(2.0 * border);
        // Where the limits of the aspect bind, the drawing is centred in the free room.
        let aspect = (size.y / size.x).clamp(ASPECT.0, ASPECT.1);
        let units_per_world = (WIDTH / size.x).min(WIDTH * aspect / size.y);
        let room = Vector2::new(WIDTH, WIDTH * aspect) / units_per_world - size;
        let low = Vector2::new(low_x, low_y).add_scalar(-border) - 0.5 * room;
        Self { view, low, units_per_world, height: WIDTH * aspect }
    }

    fn place(&self, x_in_world: &Vector3<f64>) -> Vector2<f64> {
        let at = (self.view.flatten(x_in_world) - self.low) * self.units_per_world;
        Vector2::new(at.x, self.height - at.y)
    }

    fn holds(&self, at: &Vector2<f64>) -> bool {
        (0.0..=WIDTH).contains(&at.x) && (0.0..=self.height).contains(&at.y)
    }
}

/// Range of most points and all cameras along an axis; (-1, 1) where there is nothing.
fn extent(points: &[Vector2<f64>], cameras: &[Vector2<f64>], axis: impl Fn(&Vector2<f64>) -> f64) -> (f64, f64) {
    let mut along: Vec<f64> = points.iter().map(&axis).filter(|v| v.is_finite()).collect();
    along.sort_by(f64::total_cmp);
    let stray = (along.len() as f64 * STRAY_SHARE) as usize;
    let most = along[stray.min(along.len())..along.len() - stray].iter().copied();
    let all = most.chain(cameras.iter().map(&axis).filter(|v| v.is_finite()));
    let (low, high) = all.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| (low.min(v), high.max(v)));
    if low < high { (low, high) } else { (-1.0, 1.0) }
}

/// Writes one plot. `images` are all input images, by the rank that image ids are.
pub(super) fn write(
    model: &Reconstruction,
    images: &[ImageReport],
    view: View,
    out: &mut impl Write,
) -> io::Result<()> {
    let frame = Frame::around(model, view);
    write!(out, "<svg viewBox=\"0 0 {WIDTH} {:.0}\" role=\"img\" aria-label=\"Cameras and points\">", frame.height)?;
    write_points(model, &frame, out)?;
    write!(out, "<g fill-opacity=\".25\" stroke-width=\"1.2\" stroke-linejoin=\"round\">")?;
    for (id, image) in model.images() {
        let report = images.get(id.index());
        let coarse = report.and_then(|report| report.registered_in.as_deref()) == Some("coarse_model");
        let color = if coarse { "#ffb454" } else { "#5cc8ff" };
        let [a, b, c] = wedge(image, model.camera_of(*id), &frame);
        write!(
            out,
            "<path d=\"M{:.1} {:.1}L{:.1} {:.1}L{:.1} {:.1}Z\" fill=\"{color}\" stroke=\"{color}\"><title>{}</title></path>",
            a.x,
            a.y,
            b.x,
            b.y,
            c.x,
            c.y,
            Escaped(report.map_or("", |report| &report.name))
        )?;
    }
    writeln!(out, "</g></svg>")
}

/// Dots as strokes of no length with round ends, one path for all points of nearly one colour.
fn write_points(model: &Reconstruction, frame: &Frame, out: &mut impl Write) -> io::Result<()> {
    let stride = model.num_points().div_ceil(MAX_POINTS).max(1);
    let mut groups: BTreeMap<[u8; 3], Vec<Vector2<f64>>> = BTreeMap::new();
    for (_, point) in model.points().step_by(stride) {
        let at = frame.place(&point.xyz);
        if frame.holds(&at) {
            // Eight levels a channel, from dark grey (so that black points show on the dark ground) to white.
            groups.entry(point.color.map(|level| 0x48 + (level >> 5) * 0x1a)).or_default().push(at);
        }
    }
    let share = (model.num_points() as f64 / MAX_POINTS as f64).min(1.0);
    let dot = DOT.0 + share * (DOT.1 - DOT.0);
    write!(out, "<g fill=\"none\" stroke-width=\"{dot:.1}\" stroke-linecap=\"round\">")?;
    for ([r, g, b], places) in groups {
        write!(out, "<path stroke=\"#{r:02x}{g:02x}{b:02x}\" d=\"")?;
        for at in places {
            write!(out, "M{:.1} {:.1}h0", at.x, at.y)?;
        }
        write!(out, "\"/>")?;
    }
    write!(out, "</g>")
}

/// The field of view as a triangle on the page: the centre, and the ends of the view's widest section.
fn wedge(image: &RegisteredImage, camera: &Camera, frame: &Frame) -> [Vector2<f64>; 3] {
    let world_from_cam = image.cam_from_world.inverse();
    let (width, height) = (f64::from(camera.width), f64::from(camera.height));
    let depth = WEDGE / frame.units_per_world;
    let end = |x: f64, y: f64| {
        let ray = camera.unproject(&Pixel::new(x, y)).homogeneous();
        frame.place(&world_from_cam.apply(&(ray * depth)))
    };
    let center = frame.place(&world_from_cam.translation);
    let across = [end(0.0, height / 2.0), end(width, height / 2.0)];
    let upright = [end(width / 2.0, 0.0), end(width / 2.0, height)];
    let wider = if (across[0] - across[1]).norm() >= (upright[0] - upright[1]).norm() { across } else { upright };
    [center, wider[0], wider[1]]
}
