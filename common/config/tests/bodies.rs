//! Bodies from presets and files, as a configuration names them.

#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::path::{Path, PathBuf};

use flockeye_config::{Pipeline, read_bodies};
use flockeye_geometry::body::{Bodies, squares};

/// A folder that is removed with the value.
struct Folder(PathBuf);

impl Folder {
    fn new(name: &str) -> Self {
        let path = std::env::temp_dir().join(format!("flockeye-{name}-{}", std::process::id()));
        std::fs::create_dir_all(&path).unwrap();
        Self(path)
    }

    fn write(&self, name: &str, text: &str) -> PathBuf {
        let path = self.0.join(name);
        std::fs::write(&path, text).unwrap();
        path
    }

    /// A bodies file with `squares` of this name and these ids.
    fn bodies(&self, file: &str, name: &str, first_id: u32, dictionary: &str) -> PathBuf {
        let bodies = vec![squares(name, 0.08, 0.06, first_id)];
        let bodies = Bodies::new(dictionary.into(), bodies).unwrap();
        self.write(file, &bodies.to_json().to_string())
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        drop(std::fs::remove_dir_all(&self.0));
    }
}

fn load(path: &Path) -> Pipeline {
    Pipeline::load(path, &[]).unwrap()
}

#[test]
fn a_bodies_file_far_too_large_is_refused_before_it_is_read() {
    let folder = Folder::new("large");
    let path = folder.write("bodies.json", "{}");
    std::fs::File::options().write(true).open(&path).unwrap().set_len(100_000_000).unwrap();
    let start = std::time::Instant::now();
    for path in [path.as_path(), Path::new("/dev/zero")] {
        let error = read_bodies(path).unwrap_err().to_string();
        assert!(error.contains("has more than 16 MB"), "{error}");
    }
    assert!(start.elapsed().as_secs() < 5);
}

#[test]
fn what_is_written_is_read_again() {
    let folder = Folder::new("again");
    let path = folder.bodies("bodies.json", "alpha", 3, "DICT_5X5_250");
    let (read, made) = (read_bodies(&path).unwrap(), squares("alpha", 0.08, 0.06, 3));
    let body = read.get(0).unwrap();
    assert_eq!(body.facets().len(), made.facets().len());
    for (read, made) in body.corners().zip(made.corners()) {
        assert!((read - made).norm() < 1e-12);
    }
}

#[test]
fn a_custom_body_is_taken_from_its_file_beside_the_configuration() {
    let folder = Folder::new("custom");
    folder.bodies("mine.json", "mine", 40, "DICT_5X5_250");
    let yaml = "bodies:\n  list:\n    - {name: mine, preset: custom, file: mine.json}\n    \
                - {name: box, preset: cube, edge_m: 0.1}\n";
    let bodies = load(&folder.write("a.yaml", yaml)).bodies().unwrap();
    assert_eq!((bodies.owner(56), bodies.owner(4)), (Some(0), Some(1)));
    // In proportion to the edge: 0.05 of 0.0625.
    assert!((bodies.get(1).unwrap().largest_side() - 0.08).abs() < 1e-12);

    let refused =
        |name: &str, yaml: &str| load(&folder.write(name, yaml)).bodies().unwrap_err().to_string();
    let error =
        refused("b.yaml", "bodies: {list: [{name: other, preset: custom, file: mine.json}]}");
    assert!(error.contains("mine.json has no body 'other'; it has mine"), "{error}");
    let error = refused(
        "c.yaml",
        "bodies: {dictionary: DICT_4X4_50, list: [{name: mine, preset: custom, file: mine.json}]}",
    );
    assert!(error.contains("are from DICT_5X5_250"), "{error}");
    let error = refused(
        "d.yaml",
        "bodies: {list: [{name: mine, preset: custom, file: mine.json}, {name: b, first_id: 50}]}",
    );
    assert!(error.contains("marker id 50 belongs to 'mine' and to 'b'"), "{error}");
    let error = refused("e.yaml", "bodies: {list: [{preset: custom, file: none.json}]}");
    assert!(
        error.contains("cannot read the bodies file") && error.contains("none.json"),
        "{error}"
    );
}

#[test]
fn a_dictionary_may_lie_beside_the_configuration() {
    let folder = Folder::new("beside");
    let dictionary = folder.write("mine.yml", "%YAML:1.0\n");
    let pipeline = load(&folder.write("a.yaml", "bodies: {dictionary: mine.yml}"));
    assert_eq!(Path::new(&pipeline.bodies().unwrap().dictionary), dictionary);
    let file = folder.bodies("bodies.json", "alpha", 0, "mine.yml");
    assert_eq!(Path::new(&read_bodies(&file).unwrap().dictionary), dictionary);
}

#[test]
fn simulated_bodies_replace_those_of_the_same_name() {
    let folder = Folder::new("simulated");
    folder.bodies("real.json", "alpha", 0, "DICT_5X5_250");
    let pipeline = load(&folder.write("a.yaml", "simulator: {bodies: real.json}"));
    let (configured, flown) = (pipeline.bodies().unwrap(), pipeline.simulated_bodies().unwrap());
    let sides = |bodies: &Bodies| bodies.iter().map(|b| b.largest_side()).collect::<Vec<_>>();
    assert!((sides(&configured)[0] - 0.05).abs() < 1e-12);
    assert!((sides(&flown)[0] - 0.06).abs() < 1e-12 && (sides(&flown)[1] - 0.05).abs() < 1e-12);
    folder.bodies("real.json", "alpha", 100, "DICT_5X5_250");
    let error = pipeline.simulated_bodies().unwrap_err().to_string();
    assert!(error.contains("body 'alpha' has other marker ids"), "{error}");
}
