//! `flockeye calibrate response`: the camera's response from light to code values, from an exposure
//! series.

use std::fmt::Write as _;
use std::path::PathBuf;

use anyhow::{Context, anyhow, ensure};
use clap::Args;
use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser};
use flockeye_imaging::image::LumaImage;
use flockeye_imaging::light::{CodeRange, LinearLight, TransferCurve};
use flockeye_imaging::response::{
    Exposure, FittedResponse, ResponseError, edge_shift_px, fit_response,
};
use opencv::imgcodecs::{IMREAD_GRAYSCALE, imread};
use opencv::prelude::*;
use serde_json::{Value, json};

use super::show;

/// Least rise from an entry of the printed table to the next, share of white's light.
const LEAST_RISE: f64 = 1e-5;
/// Codes from one entry of the printed table to the next, in full range.
const TABLE_STEP: usize = 5;
/// Codes for which deviations are stated. Markers have hardly any pixels beyond.
const TOLD_CODES: std::ops::RangeInclusive<usize> = 20..=240;
/// The case for which errors are stated: a marker of 50 mm at 1.5 m, in a camera with 3840 px for
/// 360 degrees.
const MARKER_M: f64 = 0.05;
const RANGE_M: f64 = 1.5;
const PIXELS_PER_RADIAN: f64 = 3840.0 / std::f64::consts::TAU;

/// Arguments of `calibrate response`.
#[derive(Debug, Args)]
pub(crate) struct CalibrateResponseArguments {
    /// The pictures of one scene, from a tripod, and how long each was exposed: a.png=1/250
    /// b.png=1/60 c.png=0.07. Three or more, with everything automatic off.
    #[arg(required = true, value_name = "PICTURE=SECONDS", value_parser = picture)]
    pub pictures: Vec<(PathBuf, f64)>,
    /// The range of the luma that the camera's video has: limited (16 to 235), as most have, or
    /// full. Pictures hold all of 0 to 255, so for limited range the table is moved to 16 to 235.
    #[arg(long, default_value = "limited", value_parser = ranges())]
    pub range: CodeRange,
    /// For a program.
    #[arg(long)]
    pub json: bool,
}

/// Parser of the code range: the codes of the video for black and white.
fn ranges() -> impl TypedValueParser<Value = CodeRange> {
    let names = [
        PossibleValue::new("limited").help("16 and 235"),
        PossibleValue::new("full").help("0 and 255"),
    ];
    PossibleValuesParser::new(names).map(|name| match name.as_str() {
        "full" => CodeRange::Full,
        _ => CodeRange::Limited,
    })
}

/// Parses a picture's file and its exposure, seconds.
fn picture(text: &str) -> Result<(PathBuf, f64), String> {
    let (file, exposure) =
        text.rsplit_once('=').ok_or("it must be PICTURE=SECONDS, as in a.png=1/250")?;
    let number = |text: &str| -> Result<f64, String> {
        text.trim().parse().map_err(|_| format!("'{text}' is no number of seconds"))
    };
    let seconds = match exposure.split_once('/') {
        Some((one, parts)) => number(one)? / number(parts)?,
        None => number(exposure)?,
    };
    if !(seconds > 0.0 && seconds.is_finite()) {
        return Err(format!("an exposure of {exposure} s; it must be above 0"));
    }
    Ok((file.into(), seconds))
}

/// Measures the response, and prints it for `pipeline.yaml`.
pub(crate) fn run(arguments: &CalibrateResponseArguments) -> anyhow::Result<()> {
    let found = of_pictures(&arguments.pictures, arguments.range)?;
    show(arguments.json, || found.as_json(), || found.text())
}

/// A measured response with its errors.
struct ResponseReport {
    response: FittedResponse,
    range: CodeRange,
    /// Shift of edges with each common response, pixels.
    usual: Vec<(&'static str, f64)>,
    pictures: usize,
}

fn of_pictures(pictures: &[(PathBuf, f64)], range: CodeRange) -> anyhow::Result<ResponseReport> {
    let mats = pictures
        .iter()
        .map(|(file, _)| {
            let name = file.display();
            let path = file.to_str().with_context(|| format!("{name}: no UTF-8"))?;
            let mat = imread(path, IMREAD_GRAYSCALE).with_context(|| format!("{name}"))?;
            ensure!(!mat.empty(), "{name} cannot be read. Cure: give a PNG or JPEG file");
            Ok(mat)
        })
        .collect::<anyhow::Result<Vec<_>>>()?;
    let mut series = Vec::new();
    for (mat, (_, seconds)) in mats.iter().zip(pictures) {
        let (width, height) = (mat.cols() as usize, mat.rows() as usize);
        let image = LumaImage::new(mat.data_bytes()?, width, height, width)?;
        series.push(Exposure { image, seconds: *seconds });
    }
    let response = fit_response(&series).map_err(|error| match pictures.get(index_of(&error)) {
        Some((file, _)) => anyhow!("{error} ({})", file.display()),
        None => anyhow!(error),
    })?;
    let usual = [
        ("srgb", LinearLight::new(TransferCurve::Srgb, CodeRange::Full)?),
        ("linear", LinearLight::new(TransferCurve::Linear, CodeRange::Full)?),
    ];
    let usual =
        usual.iter().map(|(name, curve)| (*name, edge_shift_px(curve, &response.light))).collect();
    Ok(ResponseReport { response, range, usual, pictures: pictures.len() })
}

/// The index of the picture that caused an error; beyond all pictures if no single one did.
fn index_of(error: &ResponseError) -> usize {
    match error {
        ResponseError::Seconds { index, .. } | ResponseError::Size { index, .. } => *index,
        _ => usize::MAX,
    }
}

/// The distance error of a marker whose edges are shifted by this, millimetres.
fn range_error_mm(shift_px: f64) -> f64 {
    let side_px = MARKER_M / RANGE_M * PIXELS_PER_RADIAN;
    // Both sides of a black square move by the shift.
    1e3 * RANGE_M * 2.0 * shift_px.abs() / side_px
}

impl ResponseReport {
    /// The response at equal steps of the video's code, from 0 to 255. Each entry is larger than
    /// the one before.
    fn table(&self) -> Vec<f64> {
        let light = &self.response.light;
        let mut table: Vec<f64> = match self.range {
            CodeRange::Full => {
                (0..=255).step_by(TABLE_STEP).map(|code| light.between(code.into())).collect()
            }
            // 16 is not a multiple of the step, so every code has an entry. Codes below 16 are
            // black.
            CodeRange::Limited => (0..=255)
                .map(|code| (f64::from(code) - 16.0) * 255.0 / 219.0)
                .map(|code| if code < 0.0 { code * LEAST_RISE } else { light.between(code) })
                .collect(),
        };
        table.iter_mut().for_each(|light| *light = rounded(*light));
        for k in 1..table.len() {
            table[k] = table[k].max(rounded(table[k - 1] + LEAST_RISE));
        }
        table
    }

    /// The largest deviation among [`TOLD_CODES`], as a share of light, and its code.
    fn worst(&self) -> (f64, usize) {
        let of = |code: usize| (self.response.deviations[code], code);
        TOLD_CODES.map(of).max_by(|a, b| a.0.total_cmp(&b.0)).unwrap_or((0.0, 0))
    }

    fn as_json(&self) -> Value {
        let (deviation, code) = self.worst();
        json!({
            "response_table": self.table(),
            "places": self.response.places,
            "pictures": self.pictures,
            "residual": self.response.residual,
            "seen_codes": [self.response.seen.0, self.response.seen.1],
            "worst_deviation": deviation,
            "worst_deviation_code": code,
            "edge_shift_px": self.response.edge_shift_px,
            "range_error_mm_at_1.5_m": self.response.edge_shift_px.map(range_error_mm),
            "usual_curves": self.usual.iter().map(|(name, shift_px)| json!({
                "response": name,
                "edge_shift_px": shift_px,
                "range_error_mm_at_1.5_m": range_error_mm(*shift_px),
            })).collect::<Vec<_>>(),
        })
    }

    fn text(&self) -> String {
        let FittedResponse { seen, residual, places, .. } = &self.response;
        let (deviation, code) = self.worst();
        let mut text = String::new();
        let mut line = |line: String| {
            // Writing to a string does not fail.
            let _ = writeln!(text, "{line}");
        };
        line(format!(
            "from {places} even places in {} pictures, codes {} to {}; residuals {:.1} % of light",
            self.pictures,
            seen.0,
            seen.1,
            100.0 * residual
        ));
        line(format!(
            "light of codes {} to {} is known to about {:.1} % by noise (code {code})",
            TOLD_CODES.start(),
            TOLD_CODES.end(),
            100.0 * deviation
        ));
        line("how far edges of a marker seem off, and what that makes of 1.5 m with a marker of 50 mm:".into());
        for (name, shift_px) in &self.usual {
            let error_mm = range_error_mm(*shift_px);
            line(format!("  response: {name:<7} {shift_px:+.3} px  {error_mm:6.1} mm"));
        }
        line(match self.response.edge_shift_px {
            Some(shift_px) => {
                let error_mm = range_error_mm(shift_px);
                format!("  this table        {shift_px:+.3} px  {error_mm:6.1} mm, by noise alone")
            }
            None => {
                "  this table        not known: half of the places do not tell the curve".into()
            }
        });
        line("camera:".into());
        line("  response: table".into());
        let values: Vec<String> = self.table().iter().map(f64::to_string).collect();
        line(format!("  response_table: [{}]", values.join(", ")));
        text.trim_end().to_owned()
    }
}

/// Rounds to five significant digits.
fn rounded(value: f64) -> f64 {
    format!("{value:.4e}").parse().unwrap_or(value)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use std::path::Path;

    use opencv::core::{Mat, Vector};
    use opencv::imgcodecs::imwrite;

    use super::*;

    /// Pictures of even greys in patches, by a camera whose codes are the 1.6th root of light.
    fn photograph(folder: &Path, exposures: &[f64]) -> Vec<(PathBuf, f64)> {
        let lights: Vec<f64> = (0..400).map(|k| 0.003 * 1.0145f64.powi(k)).collect();
        exposures
            .iter()
            .enumerate()
            .map(|(number, &seconds)| {
                let pixels: Vec<u8> = (0..240 * 240)
                    .map(|k| {
                        let light = lights[k % 240 / 12 + k / 240 / 12 * 20] * seconds * 100.0;
                        (255.0 * light.powf(1.0 / 1.6)).round().min(255.0) as u8
                    })
                    .collect();
                let mat = Mat::new_rows_cols_with_data(240, 240, &pixels).unwrap();
                let file = folder.join(format!("{number}.png"));
                assert!(imwrite(file.to_str().unwrap(), &mat, &Vector::new()).unwrap());
                (file, seconds)
            })
            .collect()
    }

    #[test]
    fn an_exposure_series_gives_the_cameras_curve() {
        let folder = tempfile::tempdir().unwrap();
        let pictures = photograph(folder.path(), &[0.0025, 0.005, 0.01, 0.02]);
        let found = of_pictures(&pictures, CodeRange::Full).unwrap();
        for (k, light) in found.table().into_iter().enumerate() {
            let code = TABLE_STEP * k;
            let expected = (code as f64 / 255.0).powf(1.6);
            let is_close = (light / expected - 1.0).abs() < 0.03;
            assert!(is_close || !TOLD_CODES.contains(&code), "{code}: {light}, {expected}");
        }
        let text = found.text();
        assert!(text.contains("response: table\n  response_table: [0"), "{text}");
        // A wrong curve is off by more than the measured one.
        let own_shift_px = found.response.edge_shift_px.unwrap();
        assert!(found.usual.iter().all(|(_, shift_px)| shift_px.abs() > 5.0 * own_shift_px));
        assert_eq!(found.as_json()["response_table"].as_array().unwrap().len(), 52);
        // In limited range code 16 is black, and 235 what is white in the pictures.
        let limited = of_pictures(&pictures, CodeRange::Limited).unwrap().table();
        let (full, middle) = (found.response.light.of(128), limited[16 + 110]);
        assert!((middle / f64::from(full) - 1.0).abs() < 0.01, "{middle}, {full}");
        assert!((limited[235] - 1.0).abs() < 1e-3 && limited[16] < 1e-3 && limited[255] > 1.0);
        assert!([&limited, &found.table()].iter().all(|table| table.is_sorted_by(|a, b| a < b)));
    }

    #[test]
    fn exposures_are_seconds_or_shares_of_them() {
        let expected = (PathBuf::from("a=b.png"), 0.004);
        assert_eq!(picture("a=b.png=1/250"), Ok(expected.clone()));
        assert_eq!(picture("a=b.png=0.004"), Ok(expected));
        for wrong in
            ["a.png", "a.png=", "a.png=fast", "a.png=0", "a.png=1/0", "a.png=-1/60", "a.png=nan"]
        {
            assert!(picture(wrong).is_err(), "{wrong}");
        }
    }

    #[test]
    fn what_is_wrong_with_a_series_is_said_with_its_file() {
        let folder = tempfile::tempdir().unwrap();
        let mut pictures = photograph(folder.path(), &[0.005, 0.01, 0.02]);
        let error = |pictures: &[(PathBuf, f64)]| {
            format!("{:#}", of_pictures(pictures, CodeRange::Full).err().unwrap())
        };
        assert!(error(&pictures[..2]).starts_with("2 pictures; 3 or more"));
        pictures[1].0 = folder.path().join("absent.png");
        assert!(
            error(&pictures).contains("absent.png cannot be read. Cure:"),
            "{}",
            error(&pictures)
        );
        let small = Mat::new_rows_cols_with_data(2, 2, &[1u8, 2, 3, 4]).unwrap();
        let file = folder.path().join("small.png");
        imwrite(file.to_str().unwrap(), &small, &Vector::new()).unwrap();
        pictures[1].0 = file;
        assert!(error(&pictures).contains("small.png"), "{}", error(&pictures));
    }
}
