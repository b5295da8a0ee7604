//! The sections of the page, top to bottom.

use std::collections::BTreeMap;
use std::io::{self, Write};

use super::{
    Base64, Duration, Escaped, Grouped, ImageReport, ImageState, ModelReport, Pixels, Reconstruction, Report, plot,
};

/// What came out, in a few numbers.
pub(super) fn head(report: &Report, out: &mut impl Write) -> io::Result<()> {
    let registered = report.images.iter().filter(|image| image.state == ImageState::Registered).count();
    let Report { software, input, models, .. } = report;
    writeln!(out, "<h1>{}</h1>", if models.is_empty() { "No model was found" } else { "Reconstruction report" })?;
    writeln!(
        out,
        "<p class=\"soft\">{} {} &middot; {} files, {:.1} megapixels in all</p>\n<div class=\"tiles\">",
        Escaped(&software.name),
        Escaped(&software.version),
        Grouped(input.images),
        input.megapixels
    )?;
    let mut tile =
        |value: String, label: &str| writeln!(out, "<div class=\"tile\"><b>{value}</b><span>{label}</span></div>");
    tile(format!("{} of {}", Grouped(registered), Grouped(report.images.len())), "photographs placed")?;
    if let Some(largest) = models.first() {
        tile(
            Grouped(largest.points).to_string(),
            if models.len() > 1 { "points in the largest model" } else { "points" },
        )?;
        tile(Pixels(largest.mean_reprojection_error_px).to_string(), "mean reprojection error")?;
        if models.len() > 1 {
            tile(Grouped(models.len()).to_string(), "separate models")?;
        }
    }
    tile(Duration(report.wall_s).to_string(), "time taken")?;
    tile(Duration(report.cpu_s).to_string(), &format!("processor time on {} threads", report.threads))?;
    if let Some(bytes) = report.peak_rss_bytes {
        tile(format!("{} MB", Grouped((bytes >> 20) as usize)), "memory at most")?;
    }
    writeln!(out, "</div>")
}

/// What a person should know about the run.
pub(super) fn notes(report: &Report, out: &mut impl Write) -> io::Result<()> {
    if report.notes.is_empty() {
        return Ok(());
    }
    writeln!(out, "<h2>Notes</h2>\n<div class=\"panel\"><ul class=\"notes\">")?;
    for note in &report.notes {
        writeln!(out, "<li>{}</li>", Escaped(note))?;
    }
    writeln!(out, "</ul></div>")
}

/// A model: two plots, its numbers, and how it grew.
pub(super) fn model(
    report: &Report,
    account: &ModelReport,
    model: &Reconstruction,
    out: &mut impl Write,
) -> io::Result<()> {
    writeln!(out, "<h2>Model {}</h2>\n<div class=\"panel\">", account.id)?;
    write!(
        out,
        "<p>{} photographs, {} points ({} of them seen by three photographs or more), {} observations",
        Grouped(account.images),
        Grouped(account.points),
        Grouped(account.points_3plus),
        Grouped(account.observations)
    )?;
    if let Some(length) = account.mean_track_length {
        write!(out, ", {length:.2} to a point")?;
    }
    writeln!(
        out,
        ". Reprojection error: mean {}, median {}.</p>",
        Pixels(account.mean_reprojection_error_px),
        Pixels(account.median_reprojection_error_px)
    )?;
    writeln!(out, "<div class=\"plots\">")?;
    for (view, title) in [(plot::View::Top, "From above"), (plot::View::Side, "From the side")] {
        write!(out, "<figure>")?;
        plot::write(model, &report.images, view, out)?;
        writeln!(out, "<figcaption>{title}{LEGEND}</figcaption></figure>")?;
    }
    writeln!(out, "</div>")?;
    if !account.stages.is_empty() {
        writeln!(
            out,
            "<table><tr><th>After stage</th><th class=\"number\">Photographs</th><th class=\"number\">Points</th>\
             <th class=\"number\">Seen by 3 or more</th><th class=\"number\">Mean error</th>\
             <th class=\"number\">Median error</th></tr>"
        )?;
        for stage in &account.stages {
            writeln!(
                out,
                "<tr><td>{}</td><td class=\"number\">{}</td><td class=\"number\">{}</td><td class=\"number\">{}</td>\
                 <td class=\"number\">{}</td><td class=\"number\">{}</td></tr>",
                Escaped(&stage_title(&stage.stage)),
                Grouped(stage.images),
                Grouped(stage.points),
                Grouped(stage.points_3plus),
                Pixels(stage.mean_reprojection_error_px),
                Pixels(stage.median_reprojection_error_px)
            )?;
        }
        writeln!(out, "</table>")?;
    }
    writeln!(out, "</div>")
}

const LEGEND: &str = "<span class=\"key\" style=\"background:#ffb454\"></span>camera of the coarse model\
    <span class=\"key\" style=\"background:#5cc8ff\"></span>camera added later";

/// A stage (`add_points/1`) in words.
fn stage_title(key: &str) -> String {
    let (name, iteration) = key.split_once('/').map_or((key, None), |(name, iteration)| (name, Some(iteration)));
    let title = match name {
        "intake" => "Reading the photographs",
        "features" => "Finding features",
        "coarse_match" => "Matching coarse features",
        "coarse_model" => "Coarse model",
        "add_cameras" => "Adding cameras",
        "add_points" => "Adding points",
        "refine" => "Refining everything",
        "export" => "Writing the outputs",
        other => other,
    };
    match iteration {
        Some(iteration) => format!("{title}, round {iteration}"),
        None => title.to_owned(),
    }
}

/// How long each stage took and what it counted.
pub(super) fn stages(report: &Report, out: &mut impl Write) -> io::Result<()> {
    let longest = report.stages.iter().map(|stage| stage.wall_s).fold(f64::MIN_POSITIVE, f64::max);
    writeln!(
        out,
        "<h2>Stages</h2>\n<div class=\"panel\"><table><tr><th>Stage</th><th class=\"number\">Time</th>\
         <th class=\"number\">Processor</th><th></th><th>Counts</th></tr>"
    )?;
    for stage in &report.stages {
        let key = match stage.iteration {
            Some(iteration) => format!("{}/{iteration}", stage.name),
            None => stage.name.clone(),
        };
        let counts: Vec<String> = stage
            .counts
            .iter()
            .map(|(name, &count)| {
                let count = if count.fract() == 0.0 && count >= 0.0 {
                    Grouped(count as usize).to_string()
                } else {
                    format!("{count:.3}")
                };
                format!("{} {count}", Escaped(&name.replace('_', " ")))
            })
            .collect();
        writeln!(
            out,
            "<tr><td>{}{}</td><td class=\"number\">{}</td><td class=\"number\">{}</td>\
             <td class=\"bars\"><span class=\"bar\" style=\"width:{:.1}%\"></span></td><td class=\"counts\">{}</td></tr>",
            Escaped(&stage_title(&key)),
            if stage.reused { " <span class=\"soft\">(kept from before)</span>" } else { "" },
            Duration(stage.wall_s),
            Duration(stage.cpu_s),
            100.0 * stage.wall_s / longest,
            counts.join(" &middot; ")
        )?;
    }
    writeln!(out, "</table></div>")
}

/// A card for each photograph that is in no model, with what to do about it.
pub(super) fn images_left_out(
    report: &Report,
    thumbnails: &BTreeMap<String, Vec<u8>>,
    out: &mut impl Write,
) -> io::Result<()> {
    cards("Photographs left out", report, |image| image.state != ImageState::Registered, thumbnails, out)
}

/// A card for each photograph that is in a model.
pub(super) fn images_placed(
    report: &Report,
    thumbnails: &BTreeMap<String, Vec<u8>>,
    out: &mut impl Write,
) -> io::Result<()> {
    cards("Photographs placed", report, |image| image.state == ImageState::Registered, thumbnails, out)
}

/// A section of cards, unless there is none.
fn cards(
    title: &str,
    report: &Report,
    belongs: impl Fn(&ImageReport) -> bool,
    thumbnails: &BTreeMap<String, Vec<u8>>,
    out: &mut impl Write,
) -> io::Result<()> {
    let images: Vec<&ImageReport> = report.images.iter().filter(|image| belongs(image)).collect();
    if images.is_empty() {
        return Ok(());
    }
    writeln!(out, "<h2>{title} <span class=\"soft\">({})</span></h2>\n<div class=\"grid\">", Grouped(images.len()))?;
    for image in images {
        card(image, thumbnails.get(&image.name), out)?;
    }
    writeln!(out, "</div>")
}

fn card(image: &ImageReport, thumbnail: Option<&Vec<u8>>, out: &mut impl Write) -> io::Result<()> {
    let (class, state) = match image.state {
        ImageState::Registered => ("registered", "Placed"),
        ImageState::Unregistered => ("unregistered", "Not placed"),
        ImageState::Rejected => ("rejected", "Rejected"),
    };
    write!(out, "<div class=\"card {class}\"><div class=\"picture\">")?;
    match thumbnail {
        Some(jpeg) => write!(out, "<img alt=\"\" src=\"data:image/jpeg;base64,{}\">", Base64(jpeg))?,
        None => write!(out, "no preview")?,
    }
    write!(out, "</div><div class=\"text\"><div class=\"name\">{}</div>", Escaped(&image.name))?;
    write!(out, "<span class=\"badge\">{state}</span>")?;
    if let Some(stage) = &image.registered_in {
        write!(out, " <span class=\"soft\">{}</span>", Escaped(&stage_title(stage)))?;
    }
    if let Some(reason) = &image.reason {
        write!(out, " <code>{}</code>", Escaped(reason))?;
    }
    if let Some(advice) = &image.advice {
        write!(out, "<p>{}</p>", Escaped(advice))?;
    }
    let mut facts = Vec::new();
    facts.extend(image.model.map(|model| format!("model {model}")));
    facts.extend(image.inliers.map(|count| format!("{} observations", Grouped(count))));
    facts.extend(image.mean_reprojection_error_px.map(|error| format!("error {}", Pixels(Some(error)))));
    facts.extend(image.focal_px.map(|focal| format!("focal length {focal:.0} px")));
    facts.extend(image.features.map(|count| format!("{} features", Grouped(count))));
    facts.extend(image.width.zip(image.height).map(|(width, height)| format!("{width} &times; {height}")));
    writeln!(out, "<p class=\"soft\">{}</p></div></div>", facts.join(" &middot; "))
}

/// The options of the run.
pub(super) fn settings(report: &Report, out: &mut impl Write) -> io::Result<()> {
    let options = serde_json::to_string_pretty(&report.options)?;
    writeln!(
        out,
        "<h2>Settings</h2>\n<div class=\"panel\"><details><summary>Seed {} and all options</summary>\
         <pre><code>{}</code></pre></details></div>",
        report.seed,
        Escaped(&options)
    )
}
