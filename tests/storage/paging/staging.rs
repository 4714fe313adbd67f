//! Staging memory for encoded pages in flight: never more than the run's memory plan allows.

use super::world::{PAGE_ROWS, config, meta, store};
use crate::support::faulty_engine::Faults;
use gsscale::base::ids::{PageId, PageNo};
use gsscale::page::format::codec::Codec;
use gsscale::page::format::slot_header::HEADER_BYTES;
use gsscale::paging::pager::{Pager, PagerConfig};

const FRAMES: usize = 70;
const PAGES: u32 = 2 * FRAMES as u32;

/// Fills a page with compressible contents.
fn mark(payload: &mut [u8], page: u32, round: u8) {
    payload.fill(0);
    payload[3] = page as u8;
    payload[7] = round;
}

/// Views of many pages on the drive, then writes of as many dirty pages: with few staging buffers every page arrives
/// and nothing waits forever. The number of buffers never decreases, so the last count is the maximum.
#[test]
fn a_view_of_many_encoded_pages_takes_no_more_buffers_than_were_reckoned_with() {
    for (codec, prefetch_pages) in [
        (Codec::Zstd { level: 1 }, 0),
        (Codec::Zstd { level: 1 }, 1),
        (Codec::Zstd { level: 1 }, 5),
        (Codec::Halves, 3),
        (Codec::Halves, 200),
        (Codec::Raw, 3),
    ] {
        for reorder in [false, true] {
            let faults = Faults::new();
            if reorder {
                faults.reorder(11);
            }
            let config = PagerConfig { prefetch_bytes: prefetch_pages * 8192, ..config(FRAMES) };
            let mut pager = Pager::new(config, store(codec, &faults));
            for i in 0..PAGES {
                let meta = meta(PageId::initial(i), f64::from(i), PAGE_ROWS as u32, 1);
                pager.insert(meta, |payload| mark(payload, i, 0)).unwrap();
            }
            for round in 0..4 {
                for first in [0, FRAMES as u32] {
                    let list: Vec<PageNo> = (first..first + FRAMES as u32).map(PageNo).collect();
                    let mut pages = pager.acquire_pages(&list).unwrap();
                    for (page, number) in pages.iter_mut().zip(first..) {
                        let payload = &mut page.buffer.as_mut_slice()[HEADER_BYTES..];
                        assert_eq!(payload[..8], [0, 0, 0, number as u8, 0, 0, 0, round]);
                        mark(payload, number, round + 1);
                        page.dirty = true;
                    }
                    pager.release(pages);
                }
                match round {
                    1 => pager.flush().unwrap(),
                    2 => {
                        pager.freeze().unwrap();
                        (0..3).for_each(|step| pager.prefetch(step));
                        pager.finish_frozen().unwrap();
                        pager.abort_cut();
                    }
                    _ => {}
                }
            }
            // A few buffers are the minimum; the default is larger.
            let least = if prefetch_pages == 0 { 32 } else { 4 };
            let reckoned = pager.prefetch_bytes().max(least * pager.frame_bytes()) as u64;
            let staging = pager.staging_bytes();
            assert!(staging <= reckoned, "{codec}, {prefetch_pages} pages ahead: {staging} of {reckoned}");
            assert_eq!(staging > 0, codec != Codec::Raw, "{codec}: the pages were stored raw");
        }
    }
}
