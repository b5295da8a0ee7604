//! Decoded pixels to 8-bit grey or colour, and reduction in size.

use image::imageops::{self, FilterType};
use image::{DynamicImage, ImageBuffer, Luma, Pixel};

use super::Decoded;
use crate::scene::{GrayImage, RgbImage};

/// ITU-R BT.601 luma, the same that JPEG stores: (77 r + 150 g + 29 b) / 256.
fn luma(r: u8, g: u8, b: u8) -> u8 {
    ((77 * u32::from(r) + 150 * u32::from(g) + 29 * u32::from(b) + 128) >> 8) as u8
}

/// 16 bits to 8, rounded.
fn narrow(value: u16) -> u8 {
    ((u32::from(value) * 255 + 32_767) / 65_535) as u8
}

/// A real sample, 1 being white, to 8 bits; not-a-number is black.
fn quantize(value: f32) -> u8 {
    (value.clamp(0.0, 1.0) * 255.0).round() as u8
}

/// Grey of a colour raster.
pub(super) fn rgb_to_gray(image: &RgbImage) -> GrayImage {
    let data = image.data.chunks_exact(3).map(|p| luma(p[0], p[1], p[2])).collect();
    GrayImage::new(image.width, image.height, data)
}

/// A grey raster as colour.
pub(super) fn gray_to_rgb(image: &GrayImage) -> RgbImage {
    RgbImage::new(image.width, image.height, image.data.iter().flat_map(|&v| [v; 3]).collect())
}

/// A colour of a JPEG file (ITU-T T.871, section 7) to RGB, in units of 2^-16.
pub(super) fn ycbcr_to_rgb(color: [u8; 3]) -> [u8; 3] {
    let byte = |value: i32| ((value + (1 << 15)) >> 16).clamp(0, 255) as u8;
    let [y, cb, cr] = color.map(i32::from);
    let (y, cb, cr) = (y << 16, cb - 128, cr - 128);
    [byte(y + 91_881 * cr), byte(y - 22_554 * cb - 46_802 * cr), byte(y + 116_130 * cb)]
}

/// Grey of anything; alpha is ignored.
pub(super) fn to_gray(image: &DynamicImage) -> GrayImage {
    let (width, height) = (image.width() as usize, image.height() as usize);
    let data = match image {
        DynamicImage::ImageLuma8(raster) => raster.as_raw().clone(),
        DynamicImage::ImageLumaA8(raster) => raster.as_raw().chunks_exact(2).map(|p| p[0]).collect(),
        DynamicImage::ImageLuma16(raster) => raster.as_raw().iter().map(|&v| narrow(v)).collect(),
        DynamicImage::ImageLumaA16(raster) => raster.as_raw().chunks_exact(2).map(|p| narrow(p[0])).collect(),
        _ => return rgb_to_gray(&to_rgb(image)),
    };
    GrayImage::new(width, height, data)
}

/// Colour of anything; alpha is ignored.
pub(super) fn to_rgb(image: &DynamicImage) -> RgbImage {
    fn opaque<T: Copy>(samples: &[T], channels: usize, to_byte: impl Fn(T) -> u8) -> Vec<u8> {
        samples.chunks_exact(channels).flat_map(|p| [to_byte(p[0]), to_byte(p[1]), to_byte(p[2])]).collect()
    }
    let (width, height) = (image.width() as usize, image.height() as usize);
    let data = match image {
        DynamicImage::ImageRgb8(raster) => raster.as_raw().clone(),
        DynamicImage::ImageRgba8(raster) => opaque(raster.as_raw(), 4, |v| v),
        DynamicImage::ImageRgb16(raster) => opaque(raster.as_raw(), 3, narrow),
        DynamicImage::ImageRgba16(raster) => opaque(raster.as_raw(), 4, narrow),
        DynamicImage::ImageRgb32F(raster) => opaque(raster.as_raw(), 3, quantize),
        DynamicImage::ImageRgba32F(raster) => opaque(raster.as_raw(), 4, quantize),
        DynamicImage::ImageLuma8(_)
        | DynamicImage::ImageLumaA8(_)
        | DynamicImage::ImageLuma16(_)
        | DynamicImage::ImageLumaA16(_) => return gray_to_rgb(&to_gray(image)),
        // Kinds the image crate may add later.
        _ => image.to_rgb8().into_raw(),
    };
    RgbImage::new(width, height, data)
}

/// Reduces the longer side to `max_long_side`, where it is longer. The Catmull-Rom filter of the image crate widens with the
/// reduction, so it neither aliases nor shifts: the corner of the first pixel stays at (0, 0).
pub(super) fn shrink_gray(image: GrayImage, max_long_side: Option<u32>) -> Decoded<GrayImage> {
    let GrayImage { width, height, data } = image;
    let Some((new_width, new_height)) = reduced_size(width, height, max_long_side) else {
        return Decoded { image: GrayImage::new(width, height, data), to_original: [1.0, 1.0] };
    };
    let source = raster::<Luma<u8>>(data, width, height);
    let data = imageops::resize(&source, new_width as u32, new_height as u32, FilterType::CatmullRom).into_raw();
    Decoded {
        image: GrayImage::new(new_width, new_height, data),
        to_original: [width as f64 / new_width as f64, height as f64 / new_height as f64],
    }
}

/// Reduces the longer side to `max_long_side`, where it is longer, by averaging boxes of whole pixels.
pub(super) fn shrink_rgb(image: RgbImage, max_long_side: Option<u32>) -> Decoded<RgbImage> {
    match reduced_size(image.width, image.height, max_long_side) {
        Some(size) => average_boxes(&image, size),
        None => Decoded { image, to_original: [1.0, 1.0] },
    }
}

/// Reduces both sides by the largest whole number that leaves the longer at least `least_long_side`.
pub(super) fn shrink_rgb_by_whole(image: RgbImage, least_long_side: Option<u32>) -> Decoded<RgbImage> {
    let (width, height) = (image.width, image.height);
    let by = least_long_side.map_or(1, |least| (width.max(height) / (least as usize).max(1)).max(1));
    if by == 1 {
        return Decoded { image, to_original: [1.0, 1.0] };
    }
    average_boxes(&image, ((width / by).max(1), (height / by).max(1)))
}

/// A smaller raster of the averages over boxes of whole pixels: colours and thumbnails need no better, and it costs little
/// more than reading the raster.
fn average_boxes(image: &RgbImage, (new_width, new_height): (usize, usize)) -> Decoded<RgbImage> {
    let (width, height) = (image.width, image.height);
    let edge = |at: usize, new: usize, old: usize| at * old / new;
    let columns: Vec<usize> = (0..=new_width).map(|x| edge(x, new_width, width)).collect();
    let mut data = Vec::with_capacity(3 * new_width * new_height);
    // Down the columns first: whole rows add up in vector registers, and only one row of sums a box is walked by pixels.
    let mut of_columns = vec![0_u32; 3 * width];
    for y in 0..new_height {
        of_columns.fill(0);
        let rows = edge(y, new_height, height)..edge(y + 1, new_height, height);
        for row in image.data[3 * width * rows.start..3 * width * rows.end].chunks_exact(3 * width) {
            for (sum, &value) in of_columns.iter_mut().zip(row) {
                *sum += u32::from(value);
            }
        }
        for ends in columns.windows(2) {
            let count = ((ends[1] - ends[0]) * rows.len()) as u32;
            // To divide whole numbers takes longer than to add up the box. Half a unit more keeps the quotient exact.
            let share = 1.0 / f64::from(count);
            let of_box = of_columns.as_chunks::<3>().0[ends[0]..ends[1]].iter();
            let sum = of_box.fold([0; 3], |sum: [u32; 3], column| std::array::from_fn(|k| sum[k] + column[k]));
            data.extend(sum.map(|sum| ((f64::from(sum + count / 2) + 0.5) * share) as u8));
        }
    }
    Decoded {
        image: RgbImage::new(new_width, new_height, data),
        to_original: [width as f64 / new_width as f64, height as f64 / new_height as f64],
    }
}

/// The size with the longer side at `max_long_side`; none when it is no longer already.
fn reduced_size(width: usize, height: usize, max_long_side: Option<u32>) -> Option<(usize, usize)> {
    let longer = width.max(height);
    let target = (max_long_side? as usize).max(1);
    let scaled = |side: usize| ((side * target + longer / 2) / longer).max(1);
    (longer > target).then(|| (scaled(width), scaled(height)))
}

/// The raster as the image crate has it.
fn raster<P: Pixel<Subpixel = u8>>(data: Vec<u8>, width: usize, height: usize) -> ImageBuffer<P, Vec<u8>> {
    ImageBuffer::from_raw(width as u32, height as u32, data).expect("the raster's length was checked when it was made")
}
