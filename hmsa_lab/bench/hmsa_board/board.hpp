/*
A board between a serial line and a coil: timed levels, samples, and a watchdog.

Portable C++11 without libraries or allocation, for a microcontroller and for a host. All times are
in us since the board started; levels and readings are integers in units of 1e-6 (of A or V, and of
the sensor's unit).

A request is a line `NUMBER SESSION VERB VALUES*CRC`, and so is its answer, with the same NUMBER.
CRC is CRC-16/CCITT-FALSE of the text before the star, as four hexadecimal digits. A damaged line
is not answered; a newline before a request separates it from noise. Each request may be repeated
with the same effect and answer.

    H SESSION WATCHDOG    begin a session; the coil is switched off WATCHDOG us after the last
                          request
                          -> H VERSION CAPACITY LIMIT RESOLUTION EVENTS SAMPLES, and the previous
                             session, 0 after a start or a silence
    T                     -> T TIME
    W LEVEL               output a level now, and drop all scheduled ones -> W TIME LEVEL EVENTS
    S TIME LEVEL          schedule a level; drop scheduled levels from that time on -> S, F if full
    A NUMBER              -> A FIRST TIME LEVEL ...: levels that took effect, from number FIRST on
    M NUMBER              -> M FIRST TIME READING ...: samples, in the same form
    K                     -> K: heartbeat
    C                     -> C TEMPERATURE of the coil in 1e-6 degrees Celsius; only C if it is not
                             measured, as for all unknown verbs

In answers to A and M, each TIME after the first is the difference from the previous one. Without a
session, or in that of another host, all requests except H are answered with only L.
*/
#ifndef HMSA_BOARD_HPP
#define HMSA_BOARD_HPP

#include <stdint.h>
#include <string.h>

namespace hmsa {

// A sample takes 12 bytes: reduce their number for a small microcontroller.
#ifndef HMSA_SAMPLES
#define HMSA_SAMPLES 128
#endif

enum { VERSION = 1, KEPT = 32, PER_ANSWER = 7, LONGEST_LINE = 96, LONGEST_ANSWER = 240 };

inline uint16_t checksum(const char *text, int length) {
    uint16_t crc = 0xFFFF;
    for (int i = 0; i < length; ++i) {
        crc ^= static_cast<uint16_t>(static_cast<uint8_t>(text[i]) << 8);
        for (int bit = 0; bit < 8; ++bit) {
            crc = static_cast<uint16_t>((crc & 0x8000) ? (crc << 1) ^ 0x1021 : crc << 1);
        }
    }
    return crc;
}

inline char hexadecimal(unsigned value) { return "0123456789ABCDEF"[value & 15]; }

// Values with their times, numbered from 1; the newest SIZE of them are stored.
template <int SIZE>
struct Series {
    int64_t time[SIZE];
    int32_t value[SIZE];
    int64_t count;

    void add(int64_t when, int32_t what) {
        time[count % SIZE] = when;
        value[count % SIZE] = what;
        ++count;
    }
};

class Board {
  public:
    Board(int32_t limit, int32_t resolution) {
        memset(static_cast<void *>(this), 0, sizeof *this);
        limit_ = limit;
        resolution_ = resolution > 0 ? resolution : 1;
    }

    // Receive a byte from the line; complete lines are answered.
    void receive(char byte, int64_t now) {
        if (byte != '\n') {
            if (length_ < LONGEST_LINE) {
                line_[length_] = byte;
            }
            // The excess of an overlong line is ignored, and so is the line.
            length_ += length_ <= LONGEST_LINE;
            return;
        }
        int length = length_;
        length_ = 0;
        // Ignored while an answer is being sent, so as not to truncate it: the host repeats
        // requests.
        if (length <= LONGEST_LINE && sent_ == filled_) {
            obey(length, now);
        }
    }

    // Apply levels that are due; return the output level.
    int32_t advance(int64_t now) {
        while (count_ && time_[first_] <= now) {
            level_ = level_at_[first_];
            events_.add(now, level_);
            first_ = (first_ + 1) % KEPT;
            --count_;
        }
        if (session_ && now - heard_ >= watchdog_) {
            session_ = 0;
            level_ = count_ = 0;
        }
        return level_;
    }

    void sample(int64_t when, int32_t reading) { samples_.add(when, reading); }

    // Optional: set the temperature of the coil, in 1e-6 degrees Celsius.
    void warm(int32_t temperature) {
        temperature_ = temperature;
        measures_warmth_ = true;
    }

    // Get the next byte for the line; return whether there is one.
    bool send(char &byte) {
        if (sent_ == filled_) {
            return false;
        }
        byte = answer_[sent_++];
        return true;
    }

    // Return the time at which `advance` has work; -1 for never.
    int64_t due() const {
        int64_t silence = session_ ? heard_ + watchdog_ : -1;
        return count_ && (silence < 0 || time_[first_] < silence) ? time_[first_] : silence;
    }

  private:
    int32_t limit_, resolution_, level_, temperature_;
    bool measures_warmth_;
    int64_t session_, watchdog_, heard_;
    // Scheduled levels: a ring buffer in chronological order.
    int64_t time_[KEPT];
    int32_t level_at_[KEPT];
    int first_, count_;
    Series<KEPT> events_;
    Series<HMSA_SAMPLES> samples_;
    char line_[LONGEST_LINE];
    int length_;
    char answer_[LONGEST_ANSWER];
    int filled_, sent_;
    int place_, end_;  // in the line

    // -- in --------------------------------------------------------------------------------------

    bool next(int64_t &value) {
        bool negative = place_ < end_ && line_[place_] == '-';
        place_ += negative;
        int digits = 0;
        value = 0;
        for (; place_ < end_ && line_[place_] >= '0' && line_[place_] <= '9'; ++place_, ++digits) {
            if (digits == 18) {
                return false;
            }
            value = 10 * value + (line_[place_] - '0');
        }
        value = negative ? -value : value;
        place_ += place_ < end_ && line_[place_] == ' ';
        return digits > 0;
    }

    void obey(int length, int64_t now) {
        end_ = length - 5;
        if (end_ < 1 || line_[end_] != '*') {
            return;
        }
        uint16_t crc = checksum(line_, end_);
        for (int i = 0; i < 4; ++i) {
            if (line_[end_ + 1 + i] != hexadecimal(crc >> (12 - 4 * i))) {
                return;
            }
        }
        place_ = 0;
        int64_t number, session, values[2] = {0, 0};
        if (!next(number) || !next(session) || place_ == end_) {
            return;
        }
        char verb = line_[place_++];
        place_ += place_ < end_ && line_[place_] == ' ';
        int given = 0;
        while (given < 2 && place_ < end_ && next(values[given])) {
            ++given;
        }
        if (place_ != end_) {
            return;
        }
        advance(now);
        int64_t before = session_;
        if (verb == 'H' && given == 2 && values[0] > 0 && values[1] > 0) {
            session_ = values[0];
            watchdog_ = values[1];
        }
        begin(number);
        if (verb != 'H' && (!session_ || session != session_)) {
            verb = 'L';
        } else {
            heard_ = now;
        }
        carry_out(verb, given, values, before, now);
        finish();
    }

    void carry_out(char verb, int given, const int64_t *values, int64_t before, int64_t now) {
        if (verb == 'W' && given == 1) {
            count_ = 0;
            level_ = possible(values[0]);
            put_verb(verb);
            put(now);
            put(level_);
            put(events_.count);
        } else if (verb == 'S' && given == 2) {
            while (count_ && time_[(first_ + count_ - 1) % KEPT] >= values[0]) {
                --count_;
            }
            put_verb(count_ < KEPT ? 'S' : 'F');
            if (count_ < KEPT) {
                int last = (first_ + count_++) % KEPT;
                time_[last] = values[0];
                level_at_[last] = possible(values[1]);
            }
        } else if ((verb == 'A' || verb == 'M') && given == 1) {
            put_verb(verb);
            if (verb == 'A') {
                put_series(events_, values[0]);
            } else {
                put_series(samples_, values[0]);
            }
        } else {
            put_verb(verb);
            if (verb == 'T') {
                put(now);
            } else if (verb == 'H') {
                put(VERSION);
                put(KEPT);
                put(limit_);
                put(resolution_);
                put(events_.count);
                put(samples_.count);
                put(before);
            } else if (verb == 'C' && measures_warmth_) {
                put(temperature_);
            }
        }
    }

    // Return the level, rounded and limited, that the output can have.
    int32_t possible(int64_t level) const {
        int64_t half = resolution_ / 2;
        int64_t steps = (level + (level < 0 ? -half : half)) / resolution_;
        int64_t most = limit_ / resolution_;
        steps = steps > most ? most : steps < -most ? -most : steps;
        return static_cast<int32_t>(steps * resolution_);
    }

    // -- out -------------------------------------------------------------------------------------

    void begin(int64_t number) {
        filled_ = sent_ = 0;
        put_char('\n');
        put(number);
        put(session_);
    }

    void put_char(char byte) {
        if (filled_ < LONGEST_ANSWER) {
            answer_[filled_++] = byte;
        }
    }

    void put(int64_t value) {
        char digits[20];
        int count = 0;
        uint64_t left = value < 0 ? 0 - static_cast<uint64_t>(value) : static_cast<uint64_t>(value);
        do {
            digits[count++] = static_cast<char>('0' + left % 10);
            left /= 10;
        } while (left);
        if (filled_ > 1) {
            put_char(' ');
        }
        if (value < 0) {
            put_char('-');
        }
        while (count) {
            put_char(digits[--count]);
        }
    }

    void put_verb(char verb) {
        put_char(' ');
        put_char(verb);
    }

    template <int SIZE>
    void put_series(const Series<SIZE> &series, int64_t from) {
        int64_t oldest = series.count > SIZE ? series.count - SIZE + 1 : 1;
        from = from < oldest ? oldest : from;
        put(from);
        int64_t before = 0;
        for (int i = 0; i < PER_ANSWER && from <= series.count; ++i, ++from) {
            int place = static_cast<int>((from - 1) % SIZE);
            put(series.time[place] - before);
            put(series.value[place]);
            before = series.time[place];
        }
    }

    void finish() {
        uint16_t crc = checksum(answer_ + 1, filled_ - 1);
        put_char('*');
        for (int i = 0; i < 4; ++i) {
            put_char(hexadecimal(crc >> (12 - 4 * i)));
        }
        put_char('\n');
    }
};

}  // namespace hmsa

#endif
