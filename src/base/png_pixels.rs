//! Passes a decoder only those chunks of a PNG that affect its pixels.
//!
//! A decoder keeps every text chunk and EXIF block, and inflates a colour profile into as much memory as the file says:
//! a file of 3 MB can take 3 GB. None of these changes a pixel here, because profiles are not applied. So
//! [`PixelChunks`] passes the critical chunks and the transparency to the decoder, and skips the rest.
//!
//! Invariants: 1. nothing is allocated; 2. the bytes passed are those of the file, in order; 3. a file that is cut
//! short ends early, which the decoder detects.

use std::io::{BufRead, Error, ErrorKind, Read, Result, Seek, SeekFrom};

/// Bytes that a decoder may take beside the picture: two rows of the widest accepted picture (65,535 pixels of 8 bytes
/// each), and chunks of at most 768 bytes.
pub const PNG_BUFFERS: u64 = 2 << 20;

/// Whether a chunk affects the pixels: critical chunks (upper case, PNG specification, section 5.4) and tRNS. A decoder
/// refuses unknown critical chunks, and all known ones have bounded length.
pub fn affects_pixels(kind: [u8; 4]) -> bool {
    kind[0].is_ascii_uppercase() || &kind == b"tRNS"
}

/// A PNG without the chunks that do not affect pixels.
#[derive(Debug)]
pub struct PixelChunks<R> {
    inner: R,
    /// The signature or a chunk's head; the bytes from `passed` on have not been passed yet.
    head: [u8; 8],
    passed: usize,
    filled: usize,
    /// Bytes left in the current chunk, including its checksum.
    left: u64,
}

impl<R: BufRead> PixelChunks<R> {
    /// Starts at the first byte of a PNG file. Errors: the file cannot be read.
    pub fn new(mut inner: R) -> Result<PixelChunks<R>> {
        let mut head = [0; 8];
        let filled = read_up_to(&mut inner, &mut head)?;
        Ok(PixelChunks { inner, head, passed: 0, filled, left: 0 })
    }

    /// Advances to the next byte to pass on.
    fn advance(&mut self) -> Result<()> {
        while self.passed == self.filled && self.left == 0 {
            (self.passed, self.filled) = (0, read_up_to(&mut self.inner, &mut self.head)?);
            if self.filled < self.head.len() {
                // Cut short within a head: which chunk it begins is not known.
                (self.passed, self.filled) = (0, 0);
                return Ok(());
            }
            let [a, b, c, d, kind @ ..] = self.head;
            let length = u64::from(u32::from_be_bytes([a, b, c, d])) + 4;
            if affects_pixels(kind) {
                self.left = length;
            } else {
                self.passed = self.filled;
                skip(&mut self.inner, length)?;
            }
        }
        Ok(())
    }
}

fn read_up_to(from: &mut impl BufRead, into: &mut [u8; 8]) -> Result<usize> {
    let mut filled = 0;
    while filled < into.len() {
        match from.read(&mut into[filled..]) {
            Ok(0) => break,
            Ok(read) => filled += read,
            Err(e) if e.kind() == ErrorKind::Interrupted => {}
            Err(e) => return Err(e),
        }
    }
    Ok(filled)
}

fn skip(from: &mut impl BufRead, mut bytes: u64) -> Result<()> {
    while bytes > 0 {
        let here = from.fill_buf()?.len().min(usize::try_from(bytes).unwrap_or(usize::MAX));
        if here == 0 {
            return Ok(());
        }
        from.consume(here);
        bytes -= here as u64;
    }
    Ok(())
}

impl<R: BufRead> BufRead for PixelChunks<R> {
    fn fill_buf(&mut self) -> Result<&[u8]> {
        self.advance()?;
        if self.passed < self.filled {
            return Ok(&self.head[self.passed..self.filled]);
        }
        if self.left == 0 {
            return Ok(&[]);
        }
        let here = self.inner.fill_buf()?;
        let passed = here.len().min(usize::try_from(self.left).unwrap_or(usize::MAX));
        Ok(&here[..passed])
    }

    fn consume(&mut self, bytes: usize) {
        if self.passed < self.filled {
            self.passed += bytes;
        } else {
            self.inner.consume(bytes);
            self.left -= bytes as u64;
        }
    }
}

impl<R: BufRead> Read for PixelChunks<R> {
    fn read(&mut self, into: &mut [u8]) -> Result<usize> {
        let here = self.fill_buf()?;
        let bytes = here.len().min(into.len());
        into[..bytes].copy_from_slice(&here[..bytes]);
        self.consume(bytes);
        Ok(bytes)
    }
}

/// Required by the decoder's type; decoding a picture from start to end never seeks.
impl<R: BufRead> Seek for PixelChunks<R> {
    fn seek(&mut self, _: SeekFrom) -> Result<u64> {
        Err(Error::new(ErrorKind::Unsupported, "a PNG stream cannot seek"))
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a panic is a failed test
mod tests {
    use super::*;

    const SIGNATURE: &[u8] = b"\x89PNG\r\n\x1a\n";

    fn chunk(kind: &[u8; 4], data: &[u8]) -> Vec<u8> {
        [&(data.len() as u32).to_be_bytes()[..], kind, data, b"csum"].concat()
    }

    fn passed(bytes: &[u8], buffer: usize) -> Vec<u8> {
        let mut chunks = PixelChunks::new(std::io::BufReader::with_capacity(buffer, bytes)).unwrap();
        let mut out = Vec::new();
        chunks.read_to_end(&mut out).unwrap();
        out
    }

    #[test]
    fn chunks_of_pixels_pass_and_all_others_do_not() {
        let kept = [chunk(b"IHDR", &[1; 13]), chunk(b"tRNS", &[2; 6]), chunk(b"IDAT", &[3; 500]), chunk(b"IEND", &[])];
        let others =
            [chunk(b"iCCP", &[7; 300]), chunk(b"eXIf", &[]), chunk(b"acTL", &[8; 8]), chunk(b"zTXt", &[9; 41])];
        let file: Vec<u8> =
            SIGNATURE.iter().copied().chain(kept.iter().zip(&others).flat_map(|(k, o)| [&k[..], o].concat())).collect();
        let want = [SIGNATURE, &kept.concat()].concat();
        // For any split of a chunk by the buffer.
        for buffer in [1, 7, 8, 64, 4096] {
            assert_eq!(passed(&file, buffer), want, "{buffer}");
        }
        // A file that is cut short yields a prefix of the same bytes.
        for cut in 0..file.len() {
            assert!(want.starts_with(&passed(&file[..cut], 64)), "{cut}");
        }
    }
}
