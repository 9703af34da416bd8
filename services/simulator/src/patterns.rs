//! Which cells of a marker are white.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

/// The printed patterns of one dictionary: what is inside each marker's black border, which is one
/// cell wide.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct PatternBook {
    /// The dictionary's name, as OpenCV has it: `DICT_5X5_250`.
    pub dictionary: String,
    /// Cells along a side of the pattern, without its border: at most 8.
    pub cells: u32,
    /// For each id: bit `row * cells + column`, counted from the printed top left, is set where the
    /// cell is white.
    pub white: BTreeMap<u32, u64>,
}

impl PatternBook {
    /// OpenCV's `DICT_5X5_250`.
    pub fn dict_5x5_250() -> Self {
        let white = (0..).zip(DICT_5X5_250).map(|(id, bits)| (id, u64::from(bits))).collect();
        Self { dictionary: "DICT_5X5_250".into(), cells: 5, white }
    }

    /// Whether the pattern of `id` has a white cell at `row`, `column`; `None` for an id that the
    /// book does not have.
    pub fn is_white(&self, id: u32, row: u32, column: u32) -> Option<bool> {
        self.white.get(&id).map(|bits| bits >> (row * self.cells + column) & 1 == 1)
    }
}

/// The 250 patterns, as OpenCV 4.6 draws them: bit `row * 5 + column` is set where white.
#[rustfmt::skip]
const DICT_5X5_250: [u32; 250] = [
    0x07a9b45, 0x0cec070, 0x176e1eb, 0x1df5381, 0x0495aeb, 0x1682057, 0x06fd796, 0x1ac508e, 0x0990d61, 0x14bf919,
    0x180ee79, 0x006b68b, 0x111a8cf, 0x0cd1cf4, 0x02a7e7f, 0x1fd8f14, 0x035cbd2, 0x1ec8afa, 0x04764de, 0x02f70c1,
    0x15cb769, 0x0044e15, 0x10a61ad, 0x0f690ba, 0x1881673, 0x09d334b, 0x1a2e787, 0x0c48488, 0x09cd3b8, 0x1b88848,
    0x0edd9c8, 0x19c22d8, 0x0e61604, 0x026aaa4, 0x0bb84c4, 0x0afecbc, 0x06aa332, 0x1011682, 0x1716ab2, 0x09c78c2,
    0x148296a, 0x0f3e94a, 0x1df2436, 0x1372186, 0x118fcb6, 0x0bc8d2e, 0x1d33b2e, 0x0c0253e, 0x149135e, 0x1d7dade,
    0x04e35b1, 0x13c96b1, 0x1a038f1, 0x14452d1, 0x0a5bfe9, 0x163a635, 0x01fc335, 0x1f7e885, 0x1c890e5, 0x089f6d5,
    0x11fb79d, 0x079264d, 0x0c3ba7d, 0x1c2a023, 0x177c513, 0x0a3ae43, 0x16b4363, 0x12b669b, 0x19d7abb, 0x098572f,
    0x0294dcf, 0x0a05d5e, 0x194b11b, 0x14ce630, 0x1309aa8, 0x1032e32, 0x070c02a, 0x0350b05, 0x0651943, 0x06916d3,
    0x08b96bf, 0x15a8920, 0x00e7b30, 0x07c55a0, 0x1edc680, 0x1228990, 0x1ca9690, 0x185a460, 0x147bcc0, 0x160abe0,
    0x055f1f0, 0x13c2e38, 0x189b898, 0x1c4d868, 0x1b14b68, 0x16372e8, 0x08d47c8, 0x15f7ef8, 0x00ef094, 0x17ee244,
    0x103e854, 0x126df54, 0x0200fc4, 0x03fb3e4, 0x03556c4, 0x0f4def4, 0x023092c, 0x16b900c, 0x1087a2c, 0x0174a9c,
    0x08e004c, 0x0b8e76c, 0x1205122, 0x17f3722, 0x14ef8a2, 0x0a952a2, 0x17dc862, 0x090c172, 0x1994ee2, 0x1be41f2,
    0x1b1ec3a, 0x0eebf1a, 0x01fed8a, 0x0df5c9a, 0x099995a, 0x10f80ca, 0x1e633ca, 0x08076ca, 0x1f5a4da, 0x133abfa,
    0x14266a6, 0x0f5e3a6, 0x08aec66, 0x1a330e6, 0x1ba690e, 0x101c63e, 0x095d59e, 0x062bc4e, 0x14da7ce, 0x0316421,
    0x0808f91, 0x1977561, 0x19fc451, 0x18eac29, 0x0d8a239, 0x125f8a9, 0x009b169, 0x0ed64e9, 0x0e6ecd9, 0x10763d9,
    0x1765905, 0x1614a25, 0x1a10d15, 0x042d9b5, 0x11a0ff5, 0x1c6740d, 0x018f00d, 0x14d573d, 0x132237d, 0x05f41cd,
    0x13c1acd, 0x077a2fd, 0x1cc6afd, 0x00f5c23, 0x0c19733, 0x100cca3, 0x1c644b3, 0x1511063, 0x0fc2963, 0x1217753,
    0x148e5f3, 0x14786d3, 0x097400b, 0x062ed3b, 0x121d19b, 0x04d739b, 0x102994b, 0x0e88b4b, 0x1765a7b, 0x142e25b,
    0x0083cdb, 0x093f1db, 0x1c71817, 0x0f638a7, 0x11c7587, 0x1de9db7, 0x04c0797, 0x030bad7, 0x0b99ff7, 0x080881f,
    0x0cbe01f, 0x104406f, 0x1fad86f, 0x0b7ad7f, 0x11ccc5f, 0x183525f, 0x10ef4ef, 0x13f57ef, 0x12918ff, 0x07ac5df,
    0x0f41d16, 0x1d0f099, 0x1641b99, 0x170fa27, 0x17608b8, 0x10c8354, 0x1c6822c, 0x12e03ec, 0x1d3acfc, 0x032056a,
    0x19c1cea, 0x01d1966, 0x0e8a5ce, 0x1bf34fe, 0x097e2d1, 0x0e9c3a5, 0x0d79595, 0x0ed98ad, 0x1995b4d, 0x02f8323,
    0x0789d53, 0x1c5f61b, 0x071b1fb, 0x1f166a7, 0x158e2b7, 0x161e60f, 0x1779420, 0x1e2c400, 0x0df4500, 0x0731320,
    0x1874b00, 0x0f05030, 0x063d110, 0x0da6130, 0x0bf81a0, 0x0788e80, 0x1a84380, 0x08ee780, 0x0fd9490, 0x1d808b0,
    0x018a0b0, 0x1f4b7b0, 0x07b66b0, 0x06e4f90, 0x1410b40, 0x0934640, 0x095cf60, 0x0c4f760, 0x0487c70, 0x1bb5950,
];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn marker_zero_is_the_published_one() {
        let book = PatternBook::dict_5x5_250();
        let rows: Vec<String> = (0..5)
            .map(|row| {
                (0..5)
                    .map(
                        |column| {
                            if book.is_white(0, row, column) == Some(true) { '#' } else { '.' }
                        },
                    )
                    .collect()
            })
            .collect();
        assert_eq!(rows, ["#.#..", ".#.##", ".##..", "#.#.#", "###.."]);
        assert_eq!(book.is_white(250, 0, 0), None);
    }

    #[test]
    fn no_two_patterns_are_alike() {
        let distinct: std::collections::BTreeSet<_> = DICT_5X5_250.iter().collect();
        assert_eq!(distinct.len(), 250);
    }
}
