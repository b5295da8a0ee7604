//! EXIF: what a camera wrote about its photograph, read for priors and written for rendered pictures.
//!
//! Reading never fails: broken or absent EXIF gives empty fields, because nothing here may cost a person a photograph.
//! Focal lengths are priors only, as crops and re-saves keep the tags of the original.

use std::io::{self, Cursor, Write};
use std::panic::{AssertUnwindSafe, catch_unwind};

use exif::{Field, In, Rational, Tag, Value};
use serde::{Deserialize, Serialize};

/// What is known of how a photograph was taken.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Exif {
    /// Maker of the camera.
    pub make: Option<String>,
    /// Name of the camera.
    pub model: Option<String>,
    /// Name of the lens.
    pub lens: Option<String>,
    /// Focal length in millimetres.
    pub focal_mm: Option<f64>,
    /// Focal length in millimetres of the 35 mm film lens with the same diagonal angle of view.
    pub focal_35mm: Option<f64>,
    /// Pixels a millimetre on the sensor, across, of the image as it was recorded.
    pub sensor_px_per_mm: Option<f64>,
    /// Columns of the image as it was recorded.
    pub recorded_width: Option<u32>,
    /// Rows of the image as it was recorded.
    pub recorded_height: Option<u32>,
    /// The orientation tag, 1 to 8: how the picture must be turned to stand upright. The rasters here are never turned.
    pub orientation: Option<u8>,
    /// Where it was taken.
    pub gps: Option<Gps>,
    /// When it was taken, in the camera's local time, as `YYYY:MM:DD hh:mm:ss`.
    pub taken_at: Option<String>,
}

/// A position on the earth (WGS 84).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Gps {
    /// Degrees north.
    pub latitude_deg: f64,
    /// Degrees east.
    pub longitude_deg: f64,
    /// Metres above the sea.
    pub altitude_m: Option<f64>,
}

/// Diagonal of 35 mm film (36 x 24 mm); the 35 mm equivalent is defined over the diagonal (CIPA DCG-001).
const FILM_DIAGONAL_MM: f64 = 43.266_615_305_567_87;

/// Sensor widths outside this range (millimetres) mean that the resolution tags are wrong.
const PLAUSIBLE_SENSOR_WIDTH_MM: std::ops::RangeInclusive<f64> = 2.0..=70.0;

/// Longest focal length, in multiples of the longer side, and shortest, that a photograph may state.
const PLAUSIBLE_FOCAL_RATIO: std::ops::RangeInclusive<f64> = 0.2..=50.0;

impl Exif {
    /// Reads the EXIF of a JPEG, TIFF, PNG or WebP file. Whatever is absent or broken stays empty.
    pub fn read(bytes: &[u8]) -> Self {
        catch_unwind(AssertUnwindSafe(|| read_fields(bytes))).ok().flatten().unwrap_or_default()
    }

    /// The focal length in pixels of an image of this size (in the pixels of the file, whatever its orientation tag).
    ///
    /// From the 35 mm equivalent, `f = f35 * diagonal_px / 43.27`; without it, from the focal length and the sensor's
    /// resolution, taking into account that the image may be smaller than the recorded one.
    pub fn focal_px(&self, width: u32, height: u32) -> Option<f64> {
        let (columns, rows) = (f64::from(width), f64::from(height));
        let longer = columns.max(rows);
        let plausible = |focal_px: &f64| PLAUSIBLE_FOCAL_RATIO.contains(&(focal_px / longer));
        let from_film = self.focal_35mm.map(|f| f * columns.hypot(rows) / FILM_DIAGONAL_MM).filter(plausible);
        from_film.or_else(|| self.focal_px_from_sensor(longer).filter(plausible))
    }

    fn focal_px_from_sensor(&self, longer_side: f64) -> Option<f64> {
        let (focal_mm, px_per_mm) = (self.focal_mm?, self.sensor_px_per_mm?);
        let recorded = match (self.recorded_width, self.recorded_height) {
            (Some(width), Some(height)) => f64::from(width.max(height)),
            _ => longer_side,
        };
        let sensor_width_mm = recorded / px_per_mm;
        PLAUSIBLE_SENSOR_WIDTH_MM.contains(&sensor_width_mm).then(|| focal_mm * px_per_mm * longer_side / recorded)
    }
}

fn read_fields(bytes: &[u8]) -> Option<Exif> {
    let mut reader = exif::Reader::new();
    reader.continue_on_error(true);
    let fields = reader
        .read_from_container(&mut Cursor::new(bytes))
        .or_else(|error| error.distill_partial_result(|_| {}))
        .ok()?;
    let text = |tag| match &fields.get_field(tag, In::PRIMARY)?.value {
        Value::Ascii(parts) => {
            let text = String::from_utf8_lossy(parts.first()?).trim().trim_matches('\0').to_owned();
            (!text.is_empty()).then_some(text)
        }
        _ => None,
    };
    let number = |tag| positive(first_number(&fields.get_field(tag, In::PRIMARY)?.value)?);
    let integer = |tag| fields.get_field(tag, In::PRIMARY)?.value.get_uint(0);
    // The unit of the focal plane's resolution: 2 inch (also the default), 3 centimetre; 4 and 5 are millimetre and
    // micrometre as some cameras have it.
    let unit_mm = match integer(Tag::FocalPlaneResolutionUnit) {
        Some(3) => 10.0,
        Some(4) => 1.0,
        Some(5) => 1e-3,
        _ => 25.4,
    };
    Some(Exif {
        make: text(Tag::Make),
        model: text(Tag::Model),
        lens: text(Tag::LensModel),
        focal_mm: number(Tag::FocalLength),
        focal_35mm: number(Tag::FocalLengthIn35mmFilm),
        sensor_px_per_mm: number(Tag::FocalPlaneXResolution).map(|per_unit| per_unit / unit_mm),
        recorded_width: integer(Tag::PixelXDimension).filter(|&n| n > 0),
        recorded_height: integer(Tag::PixelYDimension).filter(|&n| n > 0),
        orientation: integer(Tag::Orientation).and_then(|n| u8::try_from(n).ok()).filter(|n| (1..=8).contains(n)),
        gps: read_gps(&fields),
        taken_at: text(Tag::DateTimeOriginal),
    })
}

fn read_gps(fields: &exif::Exif) -> Option<Gps> {
    let angle_deg = |tag, reference_tag, negative: u8, limit_deg: f64| {
        let parts = match &fields.get_field(tag, In::PRIMARY)?.value {
            Value::Rational(parts) => parts,
            _ => return None,
        };
        let part = |k: usize| parts.get(k).map_or(0.0, |r| if r.denom == 0 { 0.0 } else { r.to_f64() });
        let reference = match &fields.get_field(reference_tag, In::PRIMARY)?.value {
            Value::Ascii(text) => text.first()?.first()?.to_ascii_uppercase(),
            _ => return None,
        };
        let size_deg = part(0) + part(1) / 60.0 + part(2) / 3600.0;
        (!parts.is_empty() && parts[0].denom != 0 && size_deg <= limit_deg).then_some(if reference == negative {
            -size_deg
        } else {
            size_deg
        })
    };
    let below_sea = || match &fields.get_field(Tag::GPSAltitudeRef, In::PRIMARY)?.value {
        Value::Byte(value) => value.first().copied(),
        _ => None,
    };
    let altitude_m = fields
        .get_field(Tag::GPSAltitude, In::PRIMARY)
        .and_then(|field| first_number(&field.value))
        .filter(|metres| metres.is_finite())
        .map(|metres| if below_sea() == Some(1) { -metres } else { metres });
    let gps = Gps {
        latitude_deg: angle_deg(Tag::GPSLatitude, Tag::GPSLatitudeRef, b'S', 90.0)?,
        longitude_deg: angle_deg(Tag::GPSLongitude, Tag::GPSLongitudeRef, b'W', 180.0)?,
        altitude_m,
    };
    // Receivers without a fix write (0, 0), a place in the open sea.
    (gps.latitude_deg != 0.0 || gps.longitude_deg != 0.0).then_some(gps)
}

fn first_number(value: &Value) -> Option<f64> {
    match value {
        Value::Rational(parts) => parts.first().filter(|r| r.denom != 0).map(|r| r.to_f64()),
        Value::SRational(parts) => parts.first().filter(|r| r.denom != 0).map(|r| r.to_f64()),
        Value::Float(parts) => parts.first().map(|&x| f64::from(x)),
        Value::Double(parts) => parts.first().copied(),
        _ => value.get_uint(0).map(f64::from),
    }
}

fn positive(value: f64) -> Option<f64> {
    (value.is_finite() && value > 0.0).then_some(value)
}

/// Largest content of a JPEG segment, whose length field (which counts itself) has 16 bits.
const MAX_SEGMENT_LEN: usize = 0xffff - 2;

/// Copies a JPEG to `out` with these fields as its EXIF (an APP1 segment right after the start marker). The JPEG must have
/// no EXIF yet. `sensor_px_per_mm` and the recorded size are not written.
///
/// # Errors
/// When `jpeg` does not start as a JPEG, the fields do not fit, or writing fails.
pub fn write_app1(jpeg: &[u8], exif: &Exif, out: &mut impl Write) -> io::Result<()> {
    let Some(after_start) = jpeg.strip_prefix(&[0xff, 0xd8]) else {
        return Err(io::Error::new(io::ErrorKind::InvalidInput, "not a JPEG"));
    };
    let fields = fields_to_write(exif);
    let mut writer = exif::experimental::Writer::new();
    for field in &fields {
        writer.push_field(field);
    }
    let mut tiff = Cursor::new(Vec::new());
    writer.write(&mut tiff, true).map_err(io::Error::other)?;
    let tiff = tiff.into_inner();
    const SIGNATURE: &[u8] = b"Exif\0\0";
    let len = SIGNATURE.len() + tiff.len();
    if len > MAX_SEGMENT_LEN {
        return Err(io::Error::new(io::ErrorKind::InvalidInput, "the EXIF does not fit into a segment"));
    }
    out.write_all(&[0xff, 0xd8, 0xff, 0xe1])?;
    out.write_all(&((len + 2) as u16).to_be_bytes())?;
    out.write_all(SIGNATURE)?;
    out.write_all(&tiff)?;
    out.write_all(after_start)
}

fn fields_to_write(exif: &Exif) -> Vec<Field> {
    let mut fields = vec![field(Tag::ExifVersion, Value::Undefined(b"0231".to_vec(), 0))];
    let texts = [
        (Tag::Make, &exif.make),
        (Tag::Model, &exif.model),
        (Tag::LensModel, &exif.lens),
        (Tag::DateTimeOriginal, &exif.taken_at),
    ];
    for (tag, text) in texts {
        fields.extend(text.as_ref().map(|text| field(tag, Value::Ascii(vec![text.clone().into_bytes()]))));
    }
    fields.extend(exif.focal_mm.map(|f| field(Tag::FocalLength, Value::Rational(vec![rational(f)]))));
    fields.extend(exif.focal_35mm.map(|f| field(Tag::FocalLengthIn35mmFilm, Value::Short(vec![f.round() as u16]))));
    fields.extend(exif.orientation.map(|turn| field(Tag::Orientation, Value::Short(vec![u16::from(turn)]))));
    if let Some(gps) = &exif.gps {
        let angle = |deg: f64| Value::Rational(degrees_minutes_seconds(deg.abs()));
        let letter = |letter: &[u8]| Value::Ascii(vec![letter.to_vec()]);
        fields.push(field(Tag::GPSLatitudeRef, letter(if gps.latitude_deg < 0.0 { b"S" } else { b"N" })));
        fields.push(field(Tag::GPSLatitude, angle(gps.latitude_deg)));
        fields.push(field(Tag::GPSLongitudeRef, letter(if gps.longitude_deg < 0.0 { b"W" } else { b"E" })));
        fields.push(field(Tag::GPSLongitude, angle(gps.longitude_deg)));
        if let Some(altitude_m) = gps.altitude_m {
            fields.push(field(Tag::GPSAltitudeRef, Value::Byte(vec![u8::from(altitude_m < 0.0)])));
            fields.push(field(Tag::GPSAltitude, Value::Rational(vec![rational(altitude_m.abs())])));
        }
    }
    fields
}

fn field(tag: Tag, value: Value) -> Field {
    Field { tag, ifd_num: In::PRIMARY, value }
}

/// To a thousandth.
fn rational(value: f64) -> Rational {
    Rational { num: (value * 1e3).round() as u32, denom: 1000 }
}

/// Seconds to 1e-5, which is 0.3 mm on the ground.
fn degrees_minutes_seconds(deg: f64) -> Vec<Rational> {
    let minutes = deg.fract() * 60.0;
    let seconds = minutes.fract() * 60.0;
    vec![
        Rational { num: deg as u32, denom: 1 },
        Rational { num: minutes as u32, denom: 1 },
        Rational { num: (seconds * 1e5).round() as u32, denom: 100_000 },
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sample() -> Exif {
        Exif {
            make: Some("Multistage".into()),
            model: Some("Renderer".into()),
            focal_mm: Some(28.5),
            focal_35mm: Some(35.0),
            orientation: Some(6),
            gps: Some(Gps { latitude_deg: -33.856_78, longitude_deg: 151.215_3, altitude_m: Some(-4.5) }),
            taken_at: Some("2024:05:06 07:08:09".into()),
            ..Exif::default()
        }
    }

    #[test]
    fn what_is_written_is_read() {
        let mut file = Vec::new();
        write_app1(&[0xff, 0xd8, 0xff, 0xd9], &sample(), &mut file).unwrap();
        let mut read = Exif::read(&file);
        let (gps, expected) = (read.gps.take().unwrap(), sample().gps.unwrap());
        assert!((gps.latitude_deg - expected.latitude_deg).abs() < 1e-8);
        assert!((gps.longitude_deg - expected.longitude_deg).abs() < 1e-8);
        assert_eq!(gps.altitude_m, expected.altitude_m);
        assert_eq!(read, Exif { gps: None, ..sample() });
    }

    #[test]
    fn focal_length_in_pixels() {
        let film = Exif { focal_35mm: Some(36.0), ..Exif::default() };
        assert!((film.focal_px(3600, 2400).unwrap() - 3600.0).abs() < 1e-6);
        // A 22.2 mm sensor recorded with 3888 columns, halved later.
        let sensor = Exif {
            focal_mm: Some(18.0),
            sensor_px_per_mm: Some(3888.0 / 22.2),
            recorded_width: Some(3888),
            recorded_height: Some(2592),
            ..Exif::default()
        };
        assert!((sensor.focal_px(1944, 1296).unwrap() - 1944.0 * 18.0 / 22.2).abs() < 1e-6);
        assert_eq!(Exif { focal_35mm: Some(1e6), ..Exif::default() }.focal_px(100, 100), None);
        assert_eq!(Exif::default().focal_px(100, 100), None);
    }

    #[test]
    fn broken_exif_is_no_exif() {
        let mut file = Vec::new();
        write_app1(&[0xff, 0xd8, 0xff, 0xd9], &sample(), &mut file).unwrap();
        for len in 0..file.len() {
            Exif::read(&file[..len]);
        }
        assert_eq!(Exif::read(b"no photograph"), Exif::default());
        assert!(write_app1(b"no photograph", &sample(), &mut Vec::new()).is_err());
    }
}
