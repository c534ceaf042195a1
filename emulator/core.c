// The CPU of the RP2040 (one Cortex-M0+, Thumb instructions of ARMv6-M) as an interpreter for WebAssembly.
//
// It executes what firmware does all the time. Everything rare (exception entry and return, special registers, WFI, WFE,
// SVC, BKPT) ends `run` with SLOW and is executed by rp2040js's own interpreter on the same registers, so both agree on the
// hard parts. Cycles are counted as rp2040js counts them. ROM, RAM and flash lie in this module's memory; every other
// address is a call to the bus outside.

typedef unsigned char u8;
typedef unsigned short u16;
typedef unsigned int u32;
typedef unsigned long long u64;
typedef signed char i8;
typedef short i16;
typedef int i32;

#define INLINE static inline __attribute__((always_inline))
#define LIKELY(x) __builtin_expect(!!(x), 1)
#define UNLIKELY(x) __builtin_expect(!!(x), 0)
#define EXPORT(name) __attribute__((export_name(#name)))
#define BUS(name) __attribute__((import_module("bus"), import_name(#name))) extern

// size: 1, 2 or 4 bytes. Either call may set `cpu.deadline` and add to `cpu.cycles`.
BUS(read) u32 bus_read(u32 address, u32 size);
BUS(write) void bus_write(u32 address, u32 value, u32 size);

// Why `run` returned.
enum { DEADLINE, INTERRUPT, SLOW };

// The state that the outside shares; core_compiled.mjs knows the order of the words.
static struct {
  u32 r[16];
  u32 n, z, c, v;              // each 0 or 1
  u32 primask;
  u32 interrupts_updated;      // something may have become ready to interrupt
  u32 pending_irqs, enabled_irqs;
  u32 pending_nmi, pending_pendsv, pending_svcall, pending_systick;
  i32 cycles, deadline;        // in cycles since the slice began
  u32 instructions;            // wraps
} cpu;

#define ROM_SIZE (16 * 1024)
#define RAM_BASE 0x20000000u
#define RAM_SIZE (264 * 1024)
#define FLASH_SIZE (2 * 1024 * 1024)
#define IS_FLASH(address) ((address) >> 24 == 0x10)

static u8 rom[ROM_SIZE] __attribute__((aligned(16)));
static u8 ram[RAM_SIZE] __attribute__((aligned(16)));
static u8 flash[FLASH_SIZE] __attribute__((aligned(16)));

EXPORT(state) void *state(void) { return &cpu; }
EXPORT(rom) void *rom_memory(void) { return rom; }
EXPORT(ram) void *ram_memory(void) { return ram; }
EXPORT(flash) void *flash_memory(void) { return flash; }

// ---- memory

#define DEFINE_ACCESS(bits)                                                                    \
  INLINE u32 load##bits(u32 address) {                                                         \
    u32 offset = address - RAM_BASE;                                                           \
    if (LIKELY(offset < RAM_SIZE)) return *(u##bits *)(ram + offset);                          \
    if (LIKELY(IS_FLASH(address))) return *(u##bits *)(flash + (address & (FLASH_SIZE - 1)));  \
    if (address < ROM_SIZE) return *(u##bits *)(rom + address);                                \
    return (u##bits)bus_read(address, bits / 8);                                               \
  }                                                                                            \
  INLINE void store##bits(u32 address, u32 value) {                                            \
    u32 offset = address - RAM_BASE;                                                           \
    if (LIKELY(offset < RAM_SIZE)) *(u##bits *)(ram + offset) = (u##bits)value;                \
    else bus_write(address, value, bits / 8);                                                  \
  }
DEFINE_ACCESS(8)
DEFINE_ACCESS(16)
DEFINE_ACCESS(32)

// What an access costs on top of its instruction: none on the single-cycle IO, more on the peripheral bus.
INLINE i32 load_cycles(u32 address) { return address >> 28 == 0xd ? 0 : address >> 28 == 0x4 ? 3 : 1; }
INLINE i32 store_cycles(u32 address) { return address >> 28 == 0xd ? 0 : address >> 28 == 0x4 ? 4 : 1; }

INLINE int fetch(u32 address, u32 *halfword) {
  if (LIKELY(IS_FLASH(address))) *halfword = *(u16 *)(flash + (address & (FLASH_SIZE - 1)));
  else if (LIKELY(address - RAM_BASE < RAM_SIZE)) *halfword = *(u16 *)(ram + (address - RAM_BASE));
  else if (address < ROM_SIZE) *halfword = *(u16 *)(rom + address);
  else return 0;
  return 1;
}

// ---- arithmetic with flags

typedef struct { u32 n, z, c, v; } Flags;

INLINE u32 set_nz(Flags *f, u32 value) {
  f->n = value >> 31;
  f->z = value == 0;
  return value;
}

INLINE u32 add(Flags *f, u32 a, u32 b, u32 carry) {
  u64 wide = (u64)a + b + carry;
  u32 sum = (u32)wide;
  f->c = (u32)(wide >> 32);
  f->v = ((a ^ sum) & (b ^ sum)) >> 31;
  return set_nz(f, sum);
}

INLINE u32 subtract(Flags *f, u32 a, u32 b) { return add(f, a, ~b, 1); }

// Shifts by 1 to 255 (`by` 0 leaves value and carry); an immediate 0 stands for 32 in LSR and ASR and is passed as such.
INLINE u32 shift_left(Flags *f, u32 x, u32 by) {
  if (by) {
    f->c = by > 32 ? 0 : (x >> (32 - by)) & 1;
    x = by > 31 ? 0 : x << by;
  }
  return set_nz(f, x);
}

INLINE u32 shift_right(Flags *f, u32 x, u32 by) {
  if (by) {
    f->c = by > 32 ? 0 : (x >> (by - 1)) & 1;
    x = by > 31 ? 0 : x >> by;
  }
  return set_nz(f, x);
}

INLINE u32 shift_right_signed(Flags *f, u32 x, u32 by) {
  if (by > 31) {
    f->c = x >> 31;
    x = (u32)((i32)x >> 31);
  } else if (by) {
    f->c = (x >> (by - 1)) & 1;
    x = (u32)((i32)x >> by);
  }
  return set_nz(f, x);
}

INLINE u32 rotate_right(Flags *f, u32 x, u32 by) {
  if (by) {
    x = by & 31 ? x >> (by & 31) | x << (32 - (by & 31)) : x;
    f->c = x >> 31;
  }
  return set_nz(f, x);
}

INLINE u32 condition_holds(const Flags *f, u32 condition) {
  u32 holds;
  switch (condition >> 1) {
  case 0: holds = f->z; break;                        // EQ NE
  case 1: holds = f->c; break;                        // CS CC
  case 2: holds = f->n; break;                        // MI PL
  case 3: holds = f->v; break;                        // VS VC
  case 4: holds = f->c && !f->z; break;               // HI LS
  case 5: holds = f->n == f->v; break;                // GE LT
  default: holds = !f->z && f->n == f->v; break;      // GT LE
  }
  return holds ^ (condition & 1);
}

INLINE u32 branch_target(u32 pc, u32 high, u32 low) {  // of BL
  u32 s = high >> 10 & 1, j1 = low >> 13 & 1, j2 = low >> 11 & 1;
  u32 offset = (s ? 0xff000000u : 0) | (s ^ j1 ^ 1) << 23 | (s ^ j2 ^ 1) << 22 | (high & 0x3ff) << 12 | (low & 0x7ff) << 1;
  return pc + 4 + offset;
}

INLINE void check_interrupts(void) {
  if ((cpu.pending_irqs & cpu.enabled_irqs) | cpu.pending_nmi | cpu.pending_pendsv | cpu.pending_svcall | cpu.pending_systick)
    cpu.interrupts_updated = 1;
}

// ---- the interpreter

// Execute instructions until `cpu.cycles` reaches `cpu.deadline`, an interrupt may be due, or an instruction is for rp2040js.
EXPORT(run) u32 run(void) {
  u32 *const r = cpu.r;
  Flags f = {cpu.n, cpu.z, cpu.c, cpu.v};
  u32 executed = 0, why;
  for (;; executed++) {
    if (UNLIKELY(cpu.cycles >= cpu.deadline)) { why = DEADLINE; break; }
    if (UNLIKELY(cpu.interrupts_updated)) { why = INTERRUPT; break; }

    const u32 pc = r[15] & ~1u;
    u32 op;
    if (UNLIKELY(!fetch(pc, &op))) goto slow;
    u32 next = pc + 2;
    i32 cycles = 1;

    // Fields of the encodings: registers at bits 0, 3, 6 and 8; immediates of 5 and 8 bits.
    const u32 d = op & 7, n = op >> 3 & 7, m = op >> 6 & 7, t = op >> 8 & 7, imm5 = op >> 6 & 31, imm8 = op & 255;

    switch (op >> 11) {
    case 0x00: r[d] = shift_left(&f, r[n], imm5); break;                                // LSLS Rd, Rm, #imm5
    case 0x01: r[d] = shift_right(&f, r[n], imm5 ? imm5 : 32); break;                   // LSRS
    case 0x02: r[d] = shift_right_signed(&f, r[n], imm5 ? imm5 : 32); break;            // ASRS
    case 0x03:
      switch (op >> 9 & 3) {
      case 0: r[d] = add(&f, r[n], r[m], 0); break;                                     // ADDS Rd, Rn, Rm
      case 1: r[d] = subtract(&f, r[n], r[m]); break;                                   // SUBS Rd, Rn, Rm
      case 2: r[d] = add(&f, r[n], m, 0); break;                                        // ADDS Rd, Rn, #imm3
      default: r[d] = subtract(&f, r[n], m);                                            // SUBS Rd, Rn, #imm3
      }
      break;
    case 0x04: r[t] = set_nz(&f, imm8); break;                                          // MOVS Rd, #imm8
    case 0x05: subtract(&f, r[t], imm8); break;                                         // CMP Rn, #imm8
    case 0x06: r[t] = add(&f, r[t], imm8, 0); break;                                    // ADDS Rdn, #imm8
    case 0x07: r[t] = subtract(&f, r[t], imm8); break;                                  // SUBS Rdn, #imm8

    case 0x08:
      if (!(op & 0x400)) {  // data processing on low registers
        const u32 x = r[d], y = r[n];
        switch (op >> 6 & 15) {
        case 0x0: r[d] = set_nz(&f, x & y); break;                                      // ANDS
        case 0x1: r[d] = set_nz(&f, x ^ y); break;                                      // EORS
        case 0x2: r[d] = shift_left(&f, x, y & 255); break;                             // LSLS
        case 0x3: r[d] = shift_right(&f, x, y & 255); break;                            // LSRS
        case 0x4: r[d] = shift_right_signed(&f, x, y & 255); break;                     // ASRS
        case 0x5: r[d] = add(&f, x, y, f.c); break;                                     // ADCS
        case 0x6: r[d] = add(&f, x, ~y, f.c); break;                                    // SBCS
        case 0x7: r[d] = rotate_right(&f, x, y & 255); break;                           // RORS
        case 0x8: set_nz(&f, x & y); break;                                             // TST
        case 0x9: r[d] = subtract(&f, 0, y); break;                                     // RSBS
        case 0xa: subtract(&f, x, y); break;                                            // CMP
        case 0xb: add(&f, x, y, 0); break;                                              // CMN
        case 0xc: r[d] = set_nz(&f, x | y); break;                                      // ORRS
        case 0xd: r[d] = set_nz(&f, x * y); break;                                      // MULS
        case 0xe: r[d] = set_nz(&f, x & ~y); break;                                     // BICS
        default: r[d] = set_nz(&f, ~y);                                                 // MVNS
        }
      } else {  // any register
        const u32 rm = op >> 3 & 15, rd = (op >> 4 & 8) | d, y = rm == 15 ? pc + 4 : r[rm];
        u32 result;
        switch (op >> 8 & 3) {
        case 0: result = (rd == 15 ? pc + 4 : r[rd]) + y; goto move;                    // ADD
        case 1: subtract(&f, rd == 15 ? pc + 4 : r[rd], y); break;                      // CMP
        case 2:
          result = y;                                                                   // MOV
        move:
          if (rd == 15) { next = result & ~1u; cycles++; }
          else r[rd] = rd == 13 ? result & ~3u : result;
          break;
        default:
          if (op & 7 || (!(op & 0x80) && y >> 28 == 15)) goto slow;                     // return from an exception
          if (op & 0x80) r[14] = (pc + 2) | 1;                                          // BLX
          next = y & ~1u;                                                               // BX
          cycles++;
        }
      }
      break;

    case 0x09: { const u32 a = (next + 2 & ~3u) + imm8 * 4; cycles += load_cycles(a); r[t] = load32(a); break; }  // LDR Rt, [PC]
    case 0x0a:
    case 0x0b: {  // loads and stores at Rn + Rm
      const u32 a = r[n] + r[m];
      switch (op >> 9 & 7) {
      case 0: cycles += store_cycles(a); store32(a, r[d]); break;                       // STR
      case 1: cycles += store_cycles(a); store16(a, r[d]); break;                       // STRH
      case 2: cycles += store_cycles(a); store8(a, r[d]); break;                        // STRB
      case 3: cycles += load_cycles(a); r[d] = (u32)(i8)load8(a); break;                // LDRSB
      case 4: cycles += load_cycles(a); r[d] = load32(a); break;                        // LDR
      case 5: cycles += load_cycles(a); r[d] = load16(a); break;                        // LDRH
      case 6: cycles += load_cycles(a); r[d] = load8(a); break;                         // LDRB
      default: cycles += load_cycles(a); r[d] = (u32)(i16)load16(a);                    // LDRSH
      }
      break;
    }
    case 0x0c: { const u32 a = r[n] + imm5 * 4; cycles += store_cycles(a); store32(a, r[d]); break; }   // STR Rt, [Rn, #]
    case 0x0d: { const u32 a = r[n] + imm5 * 4; cycles += load_cycles(a); r[d] = load32(a); break; }    // LDR
    case 0x0e: { const u32 a = r[n] + imm5; cycles += store_cycles(a); store8(a, r[d]); break; }        // STRB
    case 0x0f: { const u32 a = r[n] + imm5; cycles += load_cycles(a); r[d] = load8(a); break; }         // LDRB
    case 0x10: { const u32 a = r[n] + imm5 * 2; cycles += store_cycles(a); store16(a, r[d]); break; }   // STRH
    case 0x11: { const u32 a = r[n] + imm5 * 2; cycles += load_cycles(a); r[d] = load16(a); break; }    // LDRH
    case 0x12: { const u32 a = r[13] + imm8 * 4; cycles += store_cycles(a); store32(a, r[t]); break; }  // STR Rt, [SP, #]
    case 0x13: { const u32 a = r[13] + imm8 * 4; cycles += load_cycles(a); r[t] = load32(a); break; }   // LDR
    case 0x14: r[t] = (next + 2 & ~3u) + imm8 * 4; break;                               // ADR
    case 0x15: r[t] = r[13] + imm8 * 4; break;                                          // ADD Rd, SP, #

    case 0x16:
    case 0x17:
      switch (op >> 8 & 15) {
      case 0x0: r[13] += (op & 0x80 ? -1u : 1u) * ((op & 0x7f) * 4); break;             // ADD SP, SUB SP
      case 0x2: {
        const u32 x = r[n];
        switch (m & 3) {
        case 0: r[d] = (u32)(i16)x; break;                                              // SXTH
        case 1: r[d] = (u32)(i8)x; break;                                               // SXTB
        case 2: r[d] = (u16)x; break;                                                   // UXTH
        default: r[d] = (u8)x;                                                          // UXTB
        }
        break;
      }
      case 0x4:
      case 0x5: {                                                                       // PUSH
        u32 a = r[13] - 4 * (u32)__builtin_popcount(op & 0x1ff);
        r[13] = a;
        for (u32 list = imm8; list; list &= list - 1, a += 4, cycles++) store32(a, r[__builtin_ctz(list)]);
        if (op & 0x100) store32(a, r[14]);
        break;
      }
      case 0x6:
        if (op == 0xb672) cpu.primask = 1;                                              // CPSID i
        else if (op == 0xb662) { cpu.primask = 0; check_interrupts(); }                 // CPSIE i
        else goto slow;
        break;
      case 0xa: {
        const u32 x = r[n], swapped = __builtin_bswap32(x);
        switch (m & 3) {
        case 0: r[d] = swapped; break;                                                  // REV
        case 1: r[d] = swapped >> 16 | swapped << 16; break;                            // REV16
        case 3: r[d] = (u32)(i16)(swapped >> 16); break;                                // REVSH
        default: goto slow;
        }
        break;
      }
      case 0xc:
      case 0xd: {                                                                       // POP
        u32 a = r[13];
        if (op & 0x100) {
          const u32 target = load32(a + 4 * (u32)__builtin_popcount(imm8));
          if (target >> 28 == 15) goto slow;                                            // return from an exception
          next = target & ~1u;
          cycles += 2;
        }
        for (u32 list = imm8; list; list &= list - 1, a += 4, cycles++) r[__builtin_ctz(list)] = load32(a);
        r[13] = op & 0x100 ? a + 4 : a;
        break;
      }
      case 0xf:
        if (op != 0xbf00) goto slow;                                                    // NOP
        break;
      default: goto slow;
      }
      break;

    case 0x18: {                                                                        // STM
      u32 a = r[t];
      for (u32 list = imm8; list; list &= list - 1, a += 4, cycles++) store32(a, r[__builtin_ctz(list)]);
      r[t] = a;
      break;
    }
    case 0x19: {                                                                        // LDM
      u32 a = r[t];
      for (u32 list = imm8; list; list &= list - 1, a += 4, cycles++) r[__builtin_ctz(list)] = load32(a);
      if (!(imm8 >> t & 1)) r[t] = a;
      break;
    }

    case 0x1a:
    case 0x1b:
      if ((op >> 8 & 15) >= 14) goto slow;                                              // UDF, SVC
      if (condition_holds(&f, op >> 8 & 15)) { next = pc + 4 + ((u32)(i8)imm8 << 1); cycles++; }  // B<cond>
      break;
    case 0x1c: next = pc + 4 + (u32)((i32)(op << 21) >> 20); cycles++; break;           // B

    case 0x1e: {
      u32 low;
      if (UNLIKELY(!fetch(next, &low))) goto slow;
      if ((low & 0xd000) == 0xd000) {                                                   // BL
        r[14] = (pc + 4) | 1;
        next = branch_target(pc, op, low);
      } else if (op == 0xf3bf && (low & 0xff00) == 0x8f00) {                            // DSB, DMB, ISB
        next = pc + 4;
      } else if (op == 0xf3ef && (low & 0xf0ff) == 0x8010) {                            // MRS Rd, PRIMASK
        r[low >> 8 & 15] = cpu.primask;
        next = pc + 4;
      } else if ((op & 0xfff0) == 0xf380 && low == 0x8810) {                            // MSR PRIMASK, Rn
        cpu.primask = r[op & 15] & 1;
        check_interrupts();
        next = pc + 4;
      } else goto slow;
      cycles += 2;
      break;
    }
    default: goto slow;
    }
    r[15] = next;
    cpu.cycles += cycles;
    continue;

  slow:
    why = SLOW;
    break;
  }
  cpu.n = f.n, cpu.z = f.z, cpu.c = f.c, cpu.v = f.v;
  cpu.instructions += executed;
  return why;
}
