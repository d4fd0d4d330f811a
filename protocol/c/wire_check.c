/* Runs the C codec on frames from standard input, for the tests.
 *
 * Without argument: records of a 16-bit size (little-endian) and that many bytes; answers each with one byte, the
 * result of fl_decode, and for FL_OK the frame encoded again, as a record; COBS is checked on the way.
 * With "fields": one frame as hexadecimal digits; prints named fields. */
#include <stdio.h>
#include <stdlib.h>

#include "fathomlink_wire.h"

static int print_fields(void) {
    uint8_t frame[FL_LARGEST_FRAME_BYTES];
    struct fl_packet packet;
    size_t size = 0;
    unsigned byte;
    while (size < sizeof frame && scanf("%2x", &byte) == 1) frame[size++] = (uint8_t)byte;
    if (fl_decode(frame, size, &packet) != FL_OK) return 1;
    const struct fl_header *header = &packet.header;
    printf("version %u\nprofile %u\nvehicle %u\n", header->version, header->profile, header->vehicle);
    printf("boot_epoch %u\nsubmap %u\n", header->boot_epoch, header->submap);
    printf("fragment %u\nfragment_count %u\n", header->fragment, header->fragment_count);
    printf("tx_second %u\ntime_quarters %lu\n", header->tx_second, (unsigned long)header->time_quarters);
    if (header->profile == FL_SUBMAP_PAPER) {
        const struct fl_submap_paper *paper = &packet.body.submap_paper;
        for (int i = 0; i < 12; i++) printf("trajectory %.9g\n", (double)paper->trajectory[i]);
        for (int i = 0; i < 45; i++) printf("points_ned_m %.9g\n", (double)paper->points_ned_m[i]);
        for (int i = 0; i < 4; i++) printf("hyperparameters %.9g\n", (double)paper->hyperparameters[i]);
    } else if (header->profile == FL_TRAJECTORY) {
        for (int i = 0; i < 60; i++) printf("states %.9g\n", (double)packet.body.trajectory.states[i]);
    } else if (header->profile == FL_ANSWER) {
        const struct fl_answer *answer = &packet.body.answer;
        printf("submap %u\nnorth_m %.9g\n", answer->submap, (double)answer->north_m);
        printf("east_m %.9g\n", (double)answer->east_m);
    } else if (header->profile == FL_ANSWER_EXTENDED) {
        const struct fl_answer_extended *answer = &packet.body.answer_extended;
        printf("submap %u\nnorth_m %.9g\n", answer->submap, (double)answer->north_m);
        printf("east_m %.9g\nvariance_m2 %.9g\n", (double)answer->east_m, (double)answer->variance_m2);
        printf("leader_north_m %.9g\n", (double)answer->leader_north_m);
        printf("leader_east_m %.9g\n", (double)answer->leader_east_m);
        printf("leader_variance_m2 %.9g\n", (double)answer->leader_variance_m2);
        printf("repeat_submap %u\n", answer->repeat_submap);
        printf("missing_fragments %u\n", answer->missing_fragments);
    }
    return 0;
}

static int put_record(const uint8_t *data, size_t size) {
    uint8_t head[2] = {(uint8_t)size, (uint8_t)(size >> 8)};
    return fwrite(head, 1, 2, stdout) == 2 && fwrite(data, 1, size, stdout) == size;
}

int main(int count, char **arguments) {
    static uint8_t data[65536], line[66000], again[66000];
    uint8_t head[2], frame[FL_LARGEST_FRAME_BYTES];
    if (count > 1 && strcmp(arguments[1], "fields") == 0) return print_fields();
    while (fread(head, 1, 2, stdin) == 2) {
        size_t size = (size_t)head[0] | (size_t)head[1] << 8;
        if (fread(data, 1, size, stdin) != size) return 1;
        uint8_t *exact = malloc(size ? size : 1); /* so that a sanitiser sees a read beyond the end */
        if (exact == NULL) return 1;
        memcpy(exact, data, size);
        size_t wrapped = fl_wrap(exact, size, line);
        size_t back = fl_unwrap(line + 1, wrapped - 2, again);
        if (back != size || memcmp(again, data, size) != 0 || memchr(line + 1, 0, wrapped - 2)) return 2;
        (void)fl_unwrap(exact, size, again); /* any bytes, to see that nothing is read or written beyond */
        struct fl_packet packet;
        enum fl_result result = fl_decode(exact, size, &packet);
        free(exact);
        fputc((int)result, stdout);
        if (result == FL_OK && !put_record(frame, fl_encode(&packet, frame))) return 1;
        if (!put_record(line, wrapped)) return 1;
    }
    return 0;
}
